"""How far a dense disparity can be trusted: by the same matcher's disparity of the right view."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Bool, Float32
from recon.core.values.image import ASSUMED_SIGMA_PX
from recon.stereo.match.protocol import unrated_disparity

_WINDOW_PX: Final = 7  # in which the disagreement of both views is averaged
#: Odds of a match to be right to a pixel, at a disagreement of one pixel, and how they fall with
#: it: fitted on seven scenes of MiddEval3 with the features of `fine`, a cost volume of their
#: products and a soft minimum. Networks that are wrong in the same way in both views are surer.
_ODDS, _POWER = 0.9, 1.6
_LEAST_PX: Final = 0.05  # a smaller disagreement says no more


def rate_by_agreement(
    values: Float32, of_right: Float32, pair: RectifiedPair, limit_px: float
) -> Disparity:
    """Return a disparity map whose confidence and sigma follow from how well both views agree.

    Args:
        values: float32 (H, W), disparity of the left view, px; NaN = none.
        of_right: float32 (H, W), that of the right view, ``x_left - x_right`` of its pixels too.
        pair: The images.
        limit_px: Matches that differ by more are removed: as OCCLUDED where no pixel of the right
            view is matched with them, else as LEFT_RIGHT.
    """
    apart = np.abs(values - _sampled(of_right, values))
    agree = apart <= limit_px  # not where either is NaN
    reason = np.where(_seen(of_right), np.uint8(Reason.LEFT_RIGHT), np.uint8(Reason.OCCLUDED))
    reason[agree] = Reason.VALID
    reason[~np.isfinite(values)] = Reason.AMBIGUOUS
    found = unrated_disparity(values, reason, pair)
    capped = np.where(agree, apart, np.float32(limit_px))
    mean_square = cv2.blur(capped * capped, (_WINDOW_PX, _WINDOW_PX))
    disagreement = np.sqrt(mean_square)
    sure = _confidence(disagreement)
    # The difference of two estimates has twice the variance of each.
    sigma = np.sqrt(ASSUMED_SIGMA_PX**2 + mean_square / 2)
    both = np.sqrt(sure * sigma**2 + (1 - sure) * np.maximum(sigma, 1) ** 2)
    return replace(
        found,
        confidence=np.where(found.valid, sure, 0).astype(np.float32),
        sigma_px=np.where(found.valid, both, np.nan).astype(np.float32),
    )


def _confidence(disagreement: Float32) -> Float32:
    odds = _ODDS * np.maximum(disagreement, _LEAST_PX) ** -_POWER
    return np.asarray(odds / (1 + odds), dtype=np.float32)


def _sampled(of_right: Float32, values: Float32) -> Float32:
    """Return the right view's disparity where each left pixel is matched; NaN = beside it."""
    height, width = values.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    there = np.where(np.isfinite(values), columns - values, np.float32(-2))
    sampled = cv2.remap(
        of_right, there, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )
    return np.asarray(sampled, dtype=np.float32)


def _seen(of_right: Float32) -> Bool:
    """Return which pixels of the left view some pixel of the right view is matched with."""
    height, width = of_right.shape
    to = np.where(np.isfinite(of_right), np.arange(width) + of_right, -1)
    to = np.rint(np.clip(to, -1, width)).astype(np.intp) + 1
    seen = np.zeros((height, width + 2), dtype=np.bool_)
    seen[np.arange(height)[:, None], to] = True
    return seen[:, 1:-1]
