"""Disparities of matchers that do not tell how sure they are."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from recon.settings import Settings
from recon.structures import Disparity, Reason, RectifiedPair
from recon.structures.arrays import Float32, UInt8


class UnratedSettings(Settings):
    """What is assumed of every match of a matcher that rates none.

    The defaults are how OpenCV's two do on MiddEval3 at quarter size: 90 to 92 % of what they
    keep is within a pixel, and 68 % within a quarter.
    """

    assumed_confidence: float = Field(
        default=0.9, ge=0.0, le=1.0, description="Given to every match: the matcher tells none."
    )
    assumed_sigma_px: float = Field(
        default=0.25, gt=0.0, description="Given to every match: the matcher tells none."
    )


def unrated_disparity(
    values: Float32, reason: UInt8, pair: RectifiedPair, settings: UnratedSettings
) -> Disparity:
    """A disparity whose matches all count alike.

    A match that has no picture, or lies beside the right picture, becomes BORDER.

    Args:
        values: float32 (H, W), pixels; read where ``reason`` is VALID.
        reason: uint8 (H, W).
        pair: What was matched.
        settings: What is assumed.
    """
    width = values.shape[1]
    with np.errstate(invalid="ignore"):
        there = np.arange(width, dtype=np.float32) - values
        beside = (reason == np.uint8(Reason.VALID)) & ((there < -0.5) | (there > width - 0.5))
    border = beside if pair.valid is None else beside | ~pair.valid
    told = np.where(border, np.uint8(Reason.BORDER), reason)
    valid, nan = told == np.uint8(Reason.VALID), np.float32(np.nan)
    return Disparity(
        values=np.where(valid, values, nan).astype(np.float32),
        confidence=np.where(valid, np.float32(settings.assumed_confidence), np.float32(0)),
        sigma_px=np.where(valid, np.float32(settings.assumed_sigma_px), nan),
        reason=told,
    )
