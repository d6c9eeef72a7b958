"""Cores of this machine, and versions of the packages that results depend on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from recon.core.errors import DISTRIBUTION
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
