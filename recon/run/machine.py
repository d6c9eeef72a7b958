"""Threads, memory and package versions of the running process."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import resource
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import cv2
from threadpoolctl import threadpool_limits

_RECORDED: Final = (
    "recon",
    "numpy",
    "numba",
    "opencv-python-headless",
    "open3d",
    "kiss-icp",
    "pymeshlab",
)

_NICER: Final = 5
"""How much nicer background threads are: beside another on one core they get a quarter."""

_STATUS: Final = Path("/proc/self/status")
_PEAK: Final = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)


def use_threads(threads: int | None) -> int:
    """Limit OpenCV to ``threads`` (None = all cores) and return the number in use.

    More threads than cores would only take memory.
    """
    count = min(threads or available_cores(), available_cores())
    cv2.setNumThreads(count)
    return count


@contextmanager
def serial_algebra() -> Iterator[None]:
    """Keep numpy's linear algebra on one thread for the body of a ``with`` statement.

    The matrices here are small: more threads are slower while stages overlap, and sums split over
    a different number of threads round differently, so a path would depend on the machine.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        yield


def work_in_background() -> None:
    """Give this thread, and those that it starts, a lower priority, where the system can."""
    if sys.platform == "linux":  # elsewhere the priority is that of the process
        nice = os.getpriority(os.PRIO_PROCESS, 0) + _NICER
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


def available_cores() -> int:
    """Return cores that this process may use; in a container, fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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


def versions() -> dict[str, str]:
    """Return versions of Python and of the packages that affect results."""
    return {"python": platform.python_version(), **{name: _version(name) for name in _RECORDED}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
