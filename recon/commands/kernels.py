"""Compile kernels before a command needs them: those that it calls, in a process for each core.

`kernels.json` has the calls that were recorded (`scripts/record_kernels.py`), with the types of
their arguments; what it lacks is compiled where it is called. Run as a program, this file compiles
the calls of each line that it reads, and writes a line for each one.
"""

from __future__ import annotations

import fcntl
import gc
import importlib
import json
import os
import subprocess
import sys
import threading
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any, Final, NamedTuple

from numba import config, types

from recon.core.kernels.cache import PACKAGE, announce, note_compiling
from recon.core.kernels.compiled import CACHE
from recon.core.machine import available_cores
from recon.core.progress import stage, tracked

RECORDED: Final = Path(__file__).with_name("kernels.json")


class Call(NamedTuple):
    """A kernel and the types of its arguments, as text and lists."""

    module: str
    name: str
    types: list[Any]
    needed_by: list[str]  # names of what makes it, such as a matcher


def compile_kernels(*needed_by: object) -> int:
    """Compile what any of the names given calls, such as a matcher; return how many were.

    Without names it is all; a matcher that is not ours calls none. What is in the cache is left. Of
    several processes at a time one compiles, and the others wait for it.
    """
    if not missing_calls(*needed_by):
        return 0
    with (CACHE / "compiling").open("w") as lock:
        _wait_for(lock)
        calls = missing_calls(*needed_by)
        note_compiling()
        for name in tracked(_compiled(calls), "kernels", "kernels", total=len(calls)):
            announce(name)
    return len(calls)


def _wait_for(lock: IO[str]) -> None:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stage("kernels: another command compiles them")
        fcntl.flock(lock, fcntl.LOCK_EX)


def missing_calls(*needed_by: object) -> list[Call]:
    """Return the calls, of the names given if any, whose code is not in the cache."""
    found = []
    for call in [] if config.DISABLE_JIT else recorded_calls():
        if not needed_by or any(name in call.needed_by for name in needed_by):
            kernel = kernel_of(call)
            if not kernel._cache.holds(signature(call), kernel.targetctx):
                found.append(call)
    return found


def recorded_calls() -> list[Call]:
    """Return the calls that commands make, those first that take long to compile."""
    return [Call(*call) for call in json.loads(RECORDED.read_bytes())]


def kernel_of(call: Call) -> Any:
    """Return the kernel of a call."""
    return getattr(importlib.import_module(f"recon.{call.module}"), call.name)


def signature(call: Call) -> tuple[Any, ...]:
    """Return numba's types of the arguments of a call."""
    return tuple(map(_type, call.types))


def _type(text: str | list[Any]) -> Any:
    """Return numba's type for ``"int64"``, ``"uint8 2 C"``, ``"uint8 2 C readonly"``, or a tuple.

    A tuple is a list that begins with its class, or "".
    """
    if isinstance(text, list):
        module, _, name = text[0].rpartition(".")
        named = getattr(importlib.import_module(f"recon.{module}"), name) if name else None
        return types.BaseTuple.from_types(tuple(map(_type, text[1:])), named)
    dtype, *array = text.split()
    scalar = getattr(types, dtype)
    if not array:
        return scalar
    return types.Array(scalar, int(array[0]), array[1], readonly="readonly" in array)


def _compiled(calls: Sequence[Call]) -> Iterator[str]:
    """Compile calls, those of a file in one process, as they share code; yield their names.

    What a process leaves that ends too early is compiled where it is called, which says why.
    """
    files = defaultdict[str, deque[Call]](deque)
    for call in calls:
        files[call.module].append(call)
    waiting = deque(files.values())
    done = SimpleQueue[str]()
    workers = [_worker() for _ in range(min(available_cores(), len(files)))]
    try:
        for worker in workers:
            threading.Thread(target=_feed, args=(worker, waiting, done), daemon=True).start()
        for _ in calls:
            yield done.get()
    finally:
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.wait()


def _worker() -> subprocess.Popen[str]:
    """Start a process that compiles the calls that it reads."""
    # It must be able to import this package however its parent found it, and keep code where that
    # looks for it, also where each process would have a folder of its own.
    paths = os.pathsep.join(filter(None, sys.path))
    environment = {**os.environ, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(CACHE)}
    return subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=PACKAGE.parent,
        env=environment,
        text=True,
    )


def _feed(worker: subprocess.Popen[str], files: deque[deque[Call]], done: SimpleQueue[str]) -> None:
    """Let a worker compile the calls of one file after the other, while there are some."""
    assert worker.stdin  # noqa: S101 - mypy: pipes are open
    assert worker.stdout  # noqa: S101
    with suppress(IndexError):
        while True:
            for call in files.popleft():
                with suppress(OSError):  # it has ended
                    worker.stdin.write(f"{json.dumps(call)}\n")
                    worker.stdin.flush()
                    worker.stdout.readline()
                done.put(call.name)


def _compile_what_is_read() -> None:
    gc.disable()  # it is a seventh of the time, and this process ends soon
    for line in sys.stdin:
        call = Call(*json.loads(line))
        kernel_of(call).compile(signature(call))
        sys.stdout.write(f"{call.name}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    _compile_what_is_read()
