"""Repeated frames, and cameras that freeze while the other goes on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import cv2

from recon.core.values.arrays import UInt8

# Mean difference in grey levels; two exposures of a static scene differ more, by sensor noise.
_SAME_DN: Final = 0.05


@dataclass
class RepeatCounter:
    """Counts repeats in a series of pairs.

    Attributes:
        steps: Number of pairs compared with the previous pair.
        both: Number of steps in which neither image changed.
        frozen: Longest run of steps in which only the (left, right) image did not change.
    """

    steps: int = 0
    both: int = 0
    frozen: list[int] = field(default_factory=lambda: [0, 0])
    _run: list[int] = field(default_factory=lambda: [0, 0])
    _last: tuple[UInt8, UInt8] | None = None

    def restart(self) -> None:
        """Start a new series: the next pair does not follow the last one."""
        self._last, self._run = None, [0, 0]

    def add(self, left: UInt8, right: UInt8) -> None:
        """Compare a pair with the previous one.

        Args:
            left: uint8 (H, W) or (H, W, 3).
            right: uint8, same shape as ``left``.
        """
        if self._last is not None:
            self.steps += 1
            same = [_same(now, last) for now, last in zip((left, right), self._last, strict=True)]
            self.both += all(same)
            for side, alone in enumerate((same[0] and not same[1], same[1] and not same[0])):
                self._run[side] = self._run[side] + 1 if alone else 0
                self.frozen[side] = max(self.frozen[side], self._run[side])
        self._last = (left, right)


def _same(now: UInt8, last: UInt8) -> bool:
    return now.shape == last.shape and bool(cv2.absdiff(now, last).mean() < _SAME_DN)
