"""How many threads the libraries use, and at which priority."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import cv2
from threadpoolctl import threadpool_limits

from recon.run.machine import available_cores

_NICER: Final = 5
"""How much nicer background threads are: beside another on one core they get a quarter."""


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
