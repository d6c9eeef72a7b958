"""What a command calls is compiled before, in several processes; a process that ends is no harm."""

import fcntl
import json
import sys
import threading
from typing import Any

import numba
import pytest

from recon.commands import kernels
from recon.commands.config import ReconConfig
from recon.commands.kernels import Call, compile_kernels, missing_calls, recorded_calls, signature
from recon.core.kernels.cache import when_compiling
from recon.core.kernels.compiled import CACHE
from recon.core.progress import Progress, showing

compiled = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="kernels are not compiled")
CALLS = [call for call in recorded_calls() if call.module == "core.kernels.voxels"][-2:]


def test_recorded_calls_are_of_kernels_that_are_there_with_types_that_numba_knows():
    calls = recorded_calls()
    assert len({json.dumps(call[:3]) for call in calls}) == len(calls)
    for call in calls:
        kernel = kernels.kernel_of(call)
        assert kernel.__code__.co_argcount == len(signature(call))


@compiled
def test_a_matcher_of_somebody_else_needs_none(monkeypatch):
    monkeypatch.setattr(kernels, "kernel_of", None)
    assert missing_calls(None, ReconConfig(), "yours") == []


def test_types_are_read_as_numba_has_them():
    texts = ["int64", "uint8 2 C", "float32 1 A readonly", ["", "bool", "bool"]]
    found = signature(Call("", "", [*texts, ["", "int64", "bool"]], []))
    assert list(map(str, found)) == [
        "int64", "array(uint8, 2d, C)", "readonly array(float32, 1d, A)", "UniTuple(bool x 2)",
        "Tuple(int64, bool)",
    ]  # fmt: skip


@pytest.fixture
def lacking(monkeypatch):
    """Calls whose code is not in the cache, as far as anybody knows; compiling takes no time."""
    calls = list(CALLS)
    monkeypatch.setattr(kernels, "missing_calls", lambda *_: calls)
    return calls


class Shown(Progress):
    def __init__(self) -> None:
        self.told: list[Any] = []

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        self.told.append((total, unit))

    def on_step(self, step: Any) -> None:
        self.told.append("one")


@compiled
def test_each_kernel_that_lacks_is_counted_and_said(lacking):
    shown, said = Shown(), []
    with showing(shown), when_compiling(said.append):
        assert compile_kernels("map") == 2
    assert shown.told == [(2, "kernels"), "one", "one"]
    assert sorted(said) == sorted(call.name for call in lacking)


@compiled
@pytest.mark.parametrize("wrong", ["no such kernel", "killed", "no Python"])
def test_processes_that_end_too_early_leave_what_lacks_to_the_command(monkeypatch, lacking, wrong):
    start = kernels._worker

    def broken() -> Any:
        worker = start()
        if wrong == "killed":
            worker.kill()
            worker.wait()
        return worker

    if wrong == "no such kernel":
        lacking[0] = lacking[0]._replace(name="nothing")
    elif wrong == "no Python":
        monkeypatch.setattr(sys, "executable", "/bin/false")
    monkeypatch.setattr(kernels, "_worker", broken)
    assert compile_kernels() == 2  # it ends, and says so of all


@compiled
def test_an_interruption_leaves_no_process(monkeypatch, lacking):
    workers = []
    start = kernels._worker
    monkeypatch.setattr(kernels, "_worker", lambda: workers.append(start()) or workers[-1])

    def interrupt(_: str) -> None:
        raise KeyboardInterrupt

    with when_compiling(interrupt), pytest.raises(KeyboardInterrupt):
        compile_kernels()
    assert workers
    assert all(worker.poll() is not None for worker in workers)


@compiled
def test_a_second_command_waits_for_the_first_and_then_has_nothing_to_compile(monkeypatch, caplog):
    caplog.set_level("INFO", logger="recon")
    answers = iter([CALLS, []])  # before and after it had waited
    monkeypatch.setattr(kernels, "missing_calls", lambda *_: next(answers))
    with (CACHE / "compiling").open("w") as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        second: list[int] = []
        waits = threading.Thread(target=lambda: second.append(compile_kernels()))
        waits.start()
        while "another command compiles them" not in caplog.text:
            waits.join(0.01)
            assert waits.is_alive()
    waits.join(10)
    assert second == [0]


@compiled
def test_modules_of_the_folder_in_which_one_works_are_not_taken(monkeypatch, tmp_path):
    (tmp_path / "numba.py").write_text("raise SystemExit")
    (tmp_path / "json.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    worker = kernels._worker()
    answer, _ = worker.communicate(json.dumps(CALLS[0]) + "\n", timeout=60)
    assert answer == f"{CALLS[0].name}\n"
