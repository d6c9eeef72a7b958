"""The progress of a download: one step for each megabyte."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final

from typing_extensions import Self

from recon.run.progress import Progress

_BYTES: Final = 1_000_000


@dataclass(frozen=True)
class Megabyte:
    """A megabyte that has arrived; a `Step` of the progress.

    Attributes:
        number: Of how many, from 1.
        seconds: Time since the one before.
    """

    number: int
    seconds: float
    ok: bool = True
    state: str = ""

    @property
    def event(self) -> dict[str, Any]:
        """Its figures for programs."""
        return {"event": "megabyte", "number": self.number, "seconds": round(self.seconds, 3)}


class Megabytes:
    """Tells a progress of the megabytes of one file, also of those that an earlier call received.

    Args:
        name: Name of the file.
        size: Its size in bytes; None = not known until the server tells.
        progress: What shows it.
    """

    def __init__(self, name: str, size: int | None, progress: Progress) -> None:
        self._name, self._size, self._progress = name, size, progress
        self._shown, self._last = -1, time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._shown >= 0:
            self._progress.on_finish()

    def tell(self, done: int, total: int | None) -> None:
        """Show how many bytes are there, of how many."""
        if self._shown < 0:
            size = self._size or total or 0
            self._progress.on_start(self._name, math.ceil(size / _BYTES), "MB")
            self._shown = 0
        now = time.perf_counter()
        while self._shown < done // _BYTES:
            self._shown += 1
            self._progress.on_step(Megabyte(self._shown, now - self._last))
            self._last = now
