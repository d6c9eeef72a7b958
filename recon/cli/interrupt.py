"""Signals that end a command, and Ctrl-C as the end of a recording, not as an error."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

_AGAIN_S: Final = 0.1


def interrupt_on_signals() -> None:
    """Let a request to end the program interrupt it, as Ctrl-C does, wherever it is."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # else nohup has it ignored
            signal.signal(number, signal.default_int_handler)
    show = sys.unraisablehook

    def interrupt_again(lost: sys.UnraisableHookArgs) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            # In a callback, as of a weak reference, Python drops it; at once it would be here, too.
            signal.signal(signal.SIGALRM, signal.default_int_handler)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        else:
            show(lost)

    sys.unraisablehook = interrupt_again


@contextmanager
def until_interrupted() -> Iterator[Callable[[], bool]]:
    """Yield a test for SIGINT or SIGTERM; a second signal ends the program at once."""
    asked = threading.Event()
    before = {int(n): signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, frame: object) -> None:
        del frame
        asked.set()
        signal.signal(number, before[number])

    for number in before:
        signal.signal(number, note)
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
