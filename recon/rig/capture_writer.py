"""Writes a recording in a thread of its own, and measures how steady it was."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from recon.core.errors import ReconError
from recon.rig.capture import CapturedPair, Recording
from recon.rig.capture_folder import CaptureFolder

# Length of the write queue: a longer one would only hide that the disk is too slow.
_WAITING: Final = 32
# A time step longer than this many periods means that a frame was lost.
_GAP_PERIODS: Final = 1.5


@dataclass(eq=False)
class CaptureLog:
    """Timestamps of the pairs that were written."""

    left_s: list[float] = field(default_factory=list)
    right_s: list[float] = field(default_factory=list)

    def add(self, pair: CapturedPair) -> None:
        """Note a pair that was written."""
        self.left_s.append(pair.left_s)
        self.right_s.append(pair.right_s)

    @property
    def figures(self) -> dict[str, Any]:
        """Number of pairs, rate, gaps and difference in time between the cameras."""
        left_s, right_s = np.array(self.left_s), np.array(self.right_s)
        frames = len(left_s)
        steps_s, skew_s = np.diff(left_s), np.abs(right_s - left_s)
        period_s = float(np.median(steps_s)) if frames > 1 else None
        return {
            "frames": frames,
            "seconds": float(left_s[-1] - left_s[0]) if frames else 0.0,
            "rate_hz": 1 / period_s if period_s else None,
            "gaps": int((steps_s > _GAP_PERIODS * period_s).sum()) if period_s else 0,
            "skew_mean_ms": 1000 * float(skew_s.mean()) if frames else None,
            "skew_max_ms": 1000 * float(skew_s.max()) if frames else None,
        }


def write_pairs(
    pairs: Iterable[CapturedPair], target: CaptureFolder, settings: Recording, log: CaptureLog
) -> None:
    """Write in a second thread, so that the disk does not block the cameras.

    Raises:
        OutputError: A pair cannot be written; those before it stay.
    """
    waiting: queue.Queue[CapturedPair | None] = queue.Queue(_WAITING)
    failed: list[Exception] = []

    def work() -> None:
        while (pair := waiting.get()) is not None:
            if failed:
                continue  # keep draining the queue, so that the other thread does not block
            try:
                target.add(pair)
                log.add(pair)
                if settings.preview_every and (target.frames - 1) % settings.preview_every == 0:
                    target.preview(pair)
            except (ReconError, OSError, MemoryError) as error:
                failed.append(error)

    writer = threading.Thread(target=work, name="capture-writer")
    writer.start()
    try:
        for pair in pairs:
            if failed:
                break
            waiting.put(pair)
    finally:
        waiting.put(None)
        writer.join()
    if failed:
        raise failed[0]
