"""Work on the next items while this one is being used, and on the last one still."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def look_ahead(
    function: Callable[[Item], Result], items: Iterable[Item], *, depth: int = 2
) -> Iterator[Result]:
    """Yield ``function(item)`` in order, computed up to ``depth`` items ahead in one thread.

    The items are drawn in that thread too, so reading overlaps as well. At most ``depth + 1``
    results exist at a time. An error in an item or in the function is raised at its turn.
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

    At most ``threads + 1`` results exist at a time. An error is raised at its item's turn; when
    the caller leaves off, what has begun is waited for and nothing else is begun.
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
    """Does jobs in one thread, in order, while the caller goes on: one at a time.

    A job begins when the one before has ended; who brings the next one earlier waits. So at most
    one job is under way, and what it holds is all that is held longer.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="one-behind")
        self._job: Future[None] | None = None

    def begin(self, job: Callable[[], None]) -> None:
        """Begin a job, once the last one has ended.

        Raises:
            Exception: What the last job raised; then this one is not begun.
        """
        self.settle()
        self._job = self._pool.submit(job)

    def settle(self) -> None:
        """Wait until the last job has ended.

        Raises:
            Exception: What it raised, once.
        """
        job, self._job = self._job, None
        if job is not None:
            job.result()

    def abandon(self) -> None:
        """Wait until the last job has ended, whatever came of it; no other can begin."""
        self._job = None
        self._pool.shutdown(wait=True)
