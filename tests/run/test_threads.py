"""Lookahead changes when results are computed, but not the results or their order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.run import threads as lookahead
from recon.run.threads import OneBehind, look_ahead, side_by_side
from tests.run.pools import observed_pool
from tests.scenery.patience import LONG_S


@given(st.lists(st.integers()), st.integers(min_value=1, max_value=5))
def test_results_come_in_order(items: list[int], depth: int) -> None:
    assert list(look_ahead(lambda x: x + 1, items, depth=depth)) == [x + 1 for x in items]


@given(st.lists(st.integers()), st.integers(min_value=1, max_value=5))
def test_results_of_several_threads_come_in_order(items: list[int], threads: int) -> None:
    assert list(side_by_side(lambda x: x + 1, items, threads=threads)) == [x + 1 for x in items]


def test_as_many_items_are_worked_on_as_there_are_threads() -> None:
    # Each waits for the other: one thread alone would wait for ever.
    both = threading.Barrier(2, timeout=LONG_S)

    def meet(item: int) -> int:
        both.wait()
        return item

    assert list(side_by_side(meet, range(4), threads=2)) == [0, 1, 2, 3]


def test_no_more_items_are_begun_than_can_be_held() -> None:
    begun: list[int] = []

    def work(item: int) -> int:
        begun.append(item)
        return item

    results = side_by_side(work, range(100), threads=2)
    assert next(results) == 0
    results.close()
    assert len(begun) <= 3


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
    monkeypatch.setattr(lookahead, "ThreadPoolExecutor", pool)

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


def test_at_most_depth_items_are_drawn_ahead() -> None:
    drawn: list[int] = []

    def items() -> Iterator[int]:
        for item in range(100):
            drawn.append(item)
            yield item

    results = look_ahead(lambda x: x, items(), depth=3)
    assert next(results) == 0
    results.close()
    assert len(drawn) <= 5


def test_an_error_is_raised_at_its_turn() -> None:
    def fail_at_two(item: int) -> int:
        if item == 2:
            raise KeyError(item)
        return item

    results = look_ahead(fail_at_two, range(5))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(KeyError):
        next(results)


def test_an_error_of_the_source_is_raised_at_its_turn() -> None:
    def items() -> Iterator[int]:
        yield 0
        raise OSError("disk gone")

    results = look_ahead(lambda x: x, items())
    assert next(results) == 0
    with pytest.raises(OSError, match="disk gone"):
        next(results)


def test_work_happens_in_another_thread() -> None:
    [thread] = look_ahead(lambda _: threading.current_thread().name, [0])
    assert thread.startswith("look-ahead")


def test_jobs_behind_are_done_in_order() -> None:
    behind, done = OneBehind(), []
    for item in range(50):
        behind.begin(partial(done.append, item))
    behind.wait()
    assert done == list(range(50))


def test_one_job_at_a_time_is_behind() -> None:
    behind, gate, done = OneBehind(), threading.Event(), []

    def first() -> None:
        gate.wait(LONG_S)
        done.append("first")

    behind.begin(first)
    assert done == []
    threading.Timer(0.05, gate.set).start()
    behind.begin(partial(done.append, "second"))
    assert done[0] == "first"
    behind.abandon()
    assert done == ["first", "second"]


def test_an_error_of_a_job_is_raised_once_when_it_is_met() -> None:
    behind = OneBehind()
    behind.begin(partial(int, "no number"))
    with pytest.raises(ValueError, match="no number"):
        behind.wait()
    behind.wait()


def test_leaving_off_waits_and_raises_nothing() -> None:
    behind = OneBehind()
    behind.begin(partial(int, "no number"))
    behind.abandon()
