"""Cores, memory, and versions of the packages that results depend on."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import resource
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from recon.core.errors import DISTRIBUTION, SettingsError
from recon.core.plugins import packages

_RECORDED: Final = (
    "numpy", "scipy", "numba", "llvmlite", "opencv-python-headless", "open3d", "kiss-icp",
    "pymeshlab",
)  # fmt: skip


def available_cores() -> int:
    """Return cores that this process may use; in a container, fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def versions() -> dict[str, str]:
    """Return versions of Python and of the packages that affect results, plug-ins' among them."""
    own = {"python": platform.python_version(), "recon": _version(DISTRIBUTION)}
    return {**own, **{name: _version(name) for name in (*_RECORDED, *packages())}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


_STATUS: Final = Path("/proc/self/status")
_PEAK: Final = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)
_UNITS_MB: Final = {"": 1, "M": 1, "MB": 1, "G": 1000, "GB": 1000}
_SIZE: Final = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", re.ASCII)


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far, in 10⁶ bytes."""
    # On Linux, the peak from getrusage is inherited from the parent process.
    found = _PEAK.search(_STATUS.read_text()) if _STATUS.exists() else None
    if found is not None:
        return int(found[1]) * 1024 / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def return_free_memory() -> None:
    """Return what was freed to the system, where the C library can (glibc: malloc_trim(3)).

    Large arrays that come and go in several threads leave gaps between those that stay. The process
    keeps them, and they count as resident.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def parse_size_mb(text: str) -> float:
    """Parse a size into 10⁶ bytes, which is also the unit if none is given."""
    found = _SIZE.fullmatch(text)
    unit = None if found is None else _UNITS_MB.get(found[2].upper())
    if found is None or unit is None or float(found[1]) == 0:
        raise SettingsError("cannot read this size", got=text, expected="such as 2G or 1500M")
    return float(found[1]) * unit
