"""Cores, memory and its limit, and versions of the packages that results depend on."""

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

from pydantic import Field

from recon.core.errors import DISTRIBUTION, MemoryLimitError, SettingsError
from recon.core.plugins import packages
from recon.core.settings import Settings

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
#: Fractions of the limit for an open submap, the cells of one tile, and what was read from the map.
#: Sums grow by doubling and are copied when closed, so each briefly costs several times its size;
#: most of the limit is left to the libraries, the images and the matcher.
_SUBMAP_RATIO: Final = 1 / 40
_TILE_RATIO: Final = 1 / 24
_CACHE_RATIO: Final = 1 / 10
_CACHE_BYTES: Final = 100_000_000


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


class MemorySettings(Settings):
    """How much memory a run may take."""

    limit_mb: float | None = Field(None, ge=1.0, le=1_000_000_000.0)
    """Largest resident memory of the process, in 10⁶ bytes; none = no limit. Submaps and tiles are
    made smaller to meet it, so results may differ by rounding."""

    @property
    def submap_bytes(self) -> int | None:
        """Size at which a submap is closed; None = closed by the path alone."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _SUBMAP_RATIO)

    @property
    def tile_bytes(self) -> int | None:
        """Largest size of a tile's cells before they are merged; None = unlimited."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _TILE_RATIO)

    @property
    def cache_bytes(self) -> int:
        """Most that is kept in memory of what was read from a map."""
        return _CACHE_BYTES if self.limit_mb is None else int(1e6 * self.limit_mb * _CACHE_RATIO)

    def check(self, where: str) -> None:
        """Stop a run that exceeds the limit; else return what is free, for what comes next."""
        if self.limit_mb is None:
            return
        if peak_memory_mb() > self.limit_mb:
            raise MemoryLimitError(
                "the memory limit cannot be kept",
                where=where,
                got=f"{peak_memory_mb():.0f} MB",
                expected=f"at most {self.limit_mb:g} MB",
                hint="give more with --memory-limit, or take smaller images, fewer disparities "
                "or a coarser map",
            )
        return_free_memory()


def parse_size_mb(text: str) -> float:
    """Parse a size into 10⁶ bytes, which is also the unit if none is given."""
    found = _SIZE.fullmatch(text)
    unit = None if found is None else _UNITS_MB.get(found[2].upper())
    if found is None or unit is None or float(found[1]) == 0:
        raise SettingsError("cannot read this size", got=text, expected="such as 2G or 1500M")
    return float(found[1]) * unit
