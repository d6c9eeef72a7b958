"""Threads change when results are computed, but not the results or their order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from functools import partial

import cv2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.run import threads
from recon.run.machine import available_cores
from recon.run.threads import OneBehind, look_ahead, side_by_side, use_threads
from tests.run.pools import observed_pool
from tests.scenery.patience import LONG_S


@given(st.lists(st.integers()), st.integers(min_value=1, max_value=5))
def test_results_come_in_order(items: list[int], count: int) -> None:
    after = [x + 1 for x in items]
    assert list(look_ahead(lambda x: x + 1, items, depth=count)) == after
    assert list(side_by_side(lambda x: x + 1, items, threads=count)) == after


def test_as_many_items_are_worked_on_as_there_are_threads() -> None:
    # Each waits for the other: one thread alone would wait for ever.
    both = threading.Barrier(2, timeout=LONG_S)

    def meet(item: int) -> int:
        both.wait()
        return item

    assert list(side_by_side(meet, range(4), threads=2)) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("ahead", "most"), [(partial(look_ahead, depth=3), 5), (partial(side_by_side, threads=2), 3)]
)
def test_no_more_items_are_begun_than_can_be_held(
    ahead: Callable[..., Iterator[int]], most: int
) -> None:
    begun: list[int] = []

    def items() -> Iterator[int]:
        for item in range(100):
            begun.append(item)
            yield item

    results = ahead(lambda x: x, items())
    assert next(results) == 0
    results.close()  # type: ignore[attr-defined]
    assert 1 < len(begun) <= most


@pytest.fixture
def interruptible() -> Iterator[None]:
    """The first SIGINT raises `KeyboardInterrupt`, also in a background job of a shell.

    Later ones do nothing, so that one which comes just before a wait, and so does not end it,
    can be sent again.
    """
    interrupted = threading.Event()

    def interrupt(*_: object) -> None:
        if not interrupted.is_set():
            interrupted.set()
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_nothing_is_begun_after_an_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    next_drawn = threading.Event()
    pool, dropped = observed_pool()
    monkeypatch.setattr(threads, "ThreadPoolExecutor", pool)

    def items() -> Iterator[int]:
        yield 0
        next_drawn.set()
        yield from range(1, 100)

    def work(item: int) -> None:
        begun.append(item)
        next_drawn.wait(LONG_S)
        for _ in range(round(LONG_S / 0.05)):
            if dropped.wait(0.05):
                return
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        list(side_by_side(work, items(), threads=1))
    assert begun == [0]


def test_an_error_of_an_item_or_of_the_source_is_raised_at_its_turn() -> None:
    def items() -> Iterator[str]:
        yield from ("0", "1")
        raise OSError("disk gone")

    for ahead in (look_ahead, partial(side_by_side, threads=2)):
        results = ahead(int, ["0", "1", "no number", "3"])
        assert [next(results), next(results)] == [0, 1]
        with pytest.raises(ValueError, match="no number"):
            next(results)
    results = look_ahead(int, items())
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(OSError, match="disk gone"):
        next(results)


def test_jobs_behind_are_done_in_order_one_at_a_time() -> None:
    behind, gate, done = OneBehind(), threading.Event(), list[int]()

    def first() -> None:
        gate.wait(LONG_S)
        done.append(-1)

    behind.begin(first)
    assert done == []
    threading.Timer(0.05, gate.set).start()
    for item in range(50):
        behind.begin(partial(done.append, item))
        assert done[: item + 1] == list(range(-1, item))
    behind.abandon()
    assert done == list(range(-1, 50))


def test_an_error_of_a_job_behind_is_raised_once_and_not_when_it_is_abandoned() -> None:
    behind = OneBehind()
    behind.begin(partial(int, "no number"))
    with pytest.raises(ValueError, match="no number"):
        behind.wait()
    behind.wait()
    behind.begin(partial(int, "no number"))
    behind.abandon()


def test_no_more_threads_are_used_than_there_are_cores() -> None:
    cores, before = available_cores(), cv2.getNumThreads()
    assert [use_threads(1), use_threads(None), use_threads(cores + 3)] == [1, cores, cores]
    cv2.setNumThreads(before)
