"""Disparity maps: each pixel has a disparity, or the reason why it has none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from recon.errors import ShapeError
from recon.structures.arrays import Bool, Float32, UInt8, freeze


class Reason(IntEnum):
    """Why a pixel has no disparity, or VALID if it has one."""

    VALID = 0
    LOW_TEXTURE = 1
    AMBIGUOUS = 2
    LEFT_RIGHT = 3
    OCCLUDED = 4
    OUT_OF_RANGE = 5
    BORDER = 6
    SPECKLE = 7
    EDGE = 8


@dataclass(frozen=True, eq=False)
class Disparity:
    """Disparity map of the left view, with confidence and uncertainty.

    Attributes:
        values: float32 (H, W), ``x_left - x_right`` in pixels; NaN = no match.
        confidence: float32 (H, W) in [0, 1]; 0 where ``values`` is NaN.
        sigma_px: float32 (H, W), standard deviation of ``values``; NaN where ``values`` is NaN.
        reason: uint8 (H, W), a `Reason` for each pixel; VALID exactly where ``values`` is finite.
    """

    values: Float32
    confidence: Float32
    sigma_px: Float32
    reason: UInt8

    def __post_init__(self) -> None:
        freeze(self, "values", np.float32, (None, None))
        for name, dtype in (("confidence", "f4"), ("sigma_px", "f4"), ("reason", "u1")):
            freeze(self, name, dtype, self.values.shape)
        # Compared with the enum member itself, numpy would use 64 bits and take ten times as long.
        if not np.array_equal(self.valid, self.reason == np.uint8(Reason.VALID)):
            raise ShapeError("Disparity.reason is VALID where values is NaN, or the reverse")

    @property
    def valid(self) -> Bool:
        """bool (H, W), where there is a disparity."""
        return np.isfinite(self.values)

    def reject(self, mask: Bool, reason: Reason) -> Disparity:
        """A copy with the pixels of ``mask`` invalidated; those that had a value get ``reason``."""
        drop = mask & self.valid
        return Disparity(
            values=np.where(drop, np.float32(np.nan), self.values),
            confidence=np.where(drop, np.float32(0), self.confidence),
            sigma_px=np.where(drop, np.float32(np.nan), self.sigma_px),
            reason=np.where(drop, np.uint8(reason), self.reason),
        )
