"""What every matcher promises, and the disparities of those that rate nothing."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, UInt8
from recon.core.values.disparity import ASSUMED_CONFIDENCE, ASSUMED_SIGMA_PX


@runtime_checkable
class Matcher(Protocol):
    """Finds the disparity of each pixel of the left view."""

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            MatchingError: The settings do not fit the pair.
        """
        ...


def unrated_disparity(values: Float32, reason: UInt8, pair: RectifiedPair) -> Disparity:
    """Return a disparity map whose matches all have the assumed confidence and uncertainty.

    A match where there is no image, or that lies outside the right image, becomes BORDER.

    Args:
        values: float32 (H, W), pixels; read where ``reason`` is VALID.
        reason: uint8 (H, W).
        pair: What was matched.
    """
    width = values.shape[1]
    with np.errstate(invalid="ignore"):
        there = np.arange(width, dtype=np.float32) - values
        beside = (reason == np.uint8(Reason.VALID)) & ((there < -0.5) | (there > width - 0.5))
    border = beside if pair.valid is None else beside | ~pair.valid
    checked = np.where(border, np.uint8(Reason.BORDER), reason)
    valid, nan = checked == np.uint8(Reason.VALID), np.float32(np.nan)
    return Disparity(
        values=np.where(valid, values, nan).astype(np.float32),
        confidence=np.where(valid, np.float32(ASSUMED_CONFIDENCE), np.float32(0)),
        sigma_px=np.where(valid, np.float32(ASSUMED_SIGMA_PX), nan),
        reason=checked,
    )
