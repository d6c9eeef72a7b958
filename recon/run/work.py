"""Work and its cost: what runs at the same time, in how much memory; seconds."""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Final, TypeVar

import cv2
from pydantic import Field
from threadpoolctl import threadpool_limits

from recon.core.errors import MemoryLimitError, SettingsError
from recon.core.settings import Settings
from recon.run.machine import available_cores, peak_memory_mb, return_free_memory

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
        """Start a job once the previous one has ended."""
        self.wait()
        self._job = self._pool.submit(job)

    def wait(self) -> None:
        """Wait until the last job has ended."""
        job, self._job = self._job, None
        if job is not None:
            job.result()

    def abandon(self) -> None:
        """Wait until the last job has ended, ignoring its errors; no other can start."""
        self._job = None
        self._pool.shutdown(wait=True)


_UNITS_MB: Final = {"": 1, "M": 1, "MB": 1, "G": 1000, "GB": 1000}
_SIZE: Final = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", re.ASCII)
#: Shares of the limit for an open submap, the cells of one tile, and what was read from the map.
#: Sums grow by doubling and are copied when closed, so each briefly costs several times its size;
#: most of the limit is left to the libraries, the images and the matcher.
_SUBMAP_SHARE: Final = 1 / 40
_TILE_SHARE: Final = 1 / 24
_CACHE_SHARE: Final = 1 / 10
_CACHE_BYTES: Final = 100_000_000


class MemorySettings(Settings):
    """How much memory a run may take."""

    limit_mb: float | None = Field(None, ge=1.0, le=1_000_000_000.0)
    """Largest resident memory of the process, in 10⁶ bytes; none = no limit. Submaps and tiles are
    made smaller to meet it, so results may differ by rounding."""

    @property
    def submap_bytes(self) -> int | None:
        """Size at which a submap is closed; None = closed by the path alone."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _SUBMAP_SHARE)

    @property
    def tile_bytes(self) -> int | None:
        """Largest size of a tile's cells before they are merged; None = unlimited."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _TILE_SHARE)

    @property
    def cache_bytes(self) -> int:
        """Most that is kept in memory of what was read from a map."""
        return _CACHE_BYTES if self.limit_mb is None else int(1e6 * self.limit_mb * _CACHE_SHARE)

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
