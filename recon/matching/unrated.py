"""Disparities of matchers without confidence and uncertainty of their own."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from recon.settings import Settings
from recon.structures import Disparity, Reason, RectifiedPair
from recon.structures.arrays import Float32, UInt8
from recon.structures.disparity import ASSUMED_CONFIDENCE, ASSUMED_SIGMA_PX


class UnratedSettings(Settings):
    """Confidence and uncertainty that are assumed for every match.

    The defaults are those of `Disparity.from_values`, which says where they come from.
    """

    assumed_confidence: float = Field(
        default=ASSUMED_CONFIDENCE,
        ge=0.0,
        le=1.0,
        description="Confidence of every match: the matcher gives none.",
    )
    assumed_sigma_px: float = Field(
        default=ASSUMED_SIGMA_PX,
        gt=0.0,
        description="Standard deviation of every match: the matcher gives none.",
    )


def unrated_disparity(
    values: Float32, reason: UInt8, pair: RectifiedPair, settings: UnratedSettings
) -> Disparity:
    """A disparity map whose matches all have the same confidence and uncertainty.

    A match where there is no picture, or that lies outside the right picture, becomes BORDER.

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
