"""Work on the next items while this one is being used."""

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
