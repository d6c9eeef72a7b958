"""Thread pools that say when they have dropped the jobs that have not begun."""

import threading
from concurrent.futures import ThreadPoolExecutor


def observed_pool() -> tuple[type[ThreadPoolExecutor], threading.Event]:
    """A class of pools, and what is set when one has cancelled the jobs that wait.

    A running job that waits for the event needs no guess of how long the caller takes to get there.
    """
    dropped = threading.Event()

    class ObservedPool(ThreadPoolExecutor):
        def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
            super().shutdown(wait=False, cancel_futures=cancel_futures)
            dropped.set()
            super().shutdown(wait=wait)

    return ObservedPool, dropped
