"""Threads, and the seconds that stages take."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Final, TypeVar

import cv2
from threadpoolctl import threadpool_limits

from recon.core.machine import available_cores

_NICEST: Final = 19
"""The lowest priority: beside another on one core such a thread gets a seventieth."""


FEW: Final = min(2, available_cores())
"""Threads for a few large pieces of work, whose results are the same in any number of them."""


def use_threads(threads: int | None) -> int:
    """Limit OpenCV to ``threads`` (None = all cores, the most there are); return how many."""
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
    """Give this thread, and those that it starts, the lowest priority, where the system can."""
    if sys.platform == "linux":  # elsewhere the priority is that of the process
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICEST)


Item = TypeVar("Item")
Result = TypeVar("Result")


def look_ahead(
    function: Callable[[Item], Result], items: Iterable[Item], *, depth: int = 2
) -> Iterator[Result]:
    """Yield ``function(item)`` in order, computed up to ``depth`` items ahead in one thread.

    Items are read in that thread, too. At most ``depth + 1`` results exist at a time. An error in
    an item or in the function is raised at its turn.
    """
    source = iter(items)

    def work() -> tuple[Result] | None:
        try:
            item = next(source)
        except StopIteration:
            return None
        return (function(item),)

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="look-ahead") as pool:
        waiting: deque[Future[tuple[Result] | None]] = deque(
            pool.submit(work) for _ in range(depth)
        )
        while waiting:
            done = waiting.popleft().result()
            if done is None:
                return
            waiting.append(pool.submit(work))
            yield done[0]


def side_by_side(
    function: Callable[[Item], Result], items: Iterable[Item], *, threads: int
) -> Iterator[Result]:
    """Yield ``function(item)`` in order, computed in several threads.

    At most ``threads + 1`` results exist at a time. An error is raised at its turn. When the caller
    stops early, running items are waited for and no others start.
    """
    pool = ThreadPoolExecutor(threads, thread_name_prefix="side-by-side")
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


class OneBehind:
    """Runs jobs in one background thread, in order; only the data of one stay in memory."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="one-behind")
        self._job: Future[None] | None = None

    def begin(self, job: Callable[[], None]) -> None:
        self.wait()
        self._job = self._pool.submit(job)

    def wait(self) -> None:
        job, self._job = self._job, None
        if job is not None:
            job.result()

    def abandon(self) -> None:
        """Wait until the last job has ended, ignoring its errors; no other can start."""
        self._job = None
        self._pool.shutdown(wait=True)


class Stopwatch:
    """Sums the wall-clock seconds of named stages; thread-safe."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._lock = threading.Lock()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body of a ``with`` statement as part of stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            with self._lock:
                self._seconds[name] = self._seconds.get(name, 0.0) + elapsed

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per stage, in the order in which the stages first ended."""
        with self._lock:
            return dict(self._seconds)
