"""Dense maps: what a matcher did not find, or not surely, by planes of the segments around it."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Bool, Float32
from recon.stereo.kernels.planes import mark_hidden
from recon.stereo.kernels.refine import SIGMA_LARGEST_PX
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.segments import SAME_SURFACE_PX, SEGMENTATIONS, fit_segments, smooth_colours

_UNLIKELY: Final = 0.5  # below this confidence a disparity is more likely wrong than right
# How many of the filled disparities of MiddEval3 were right, by how many segmentations agreed.
_CONFIDENCE: Final = np.array([0.39, 0.66, 0.78, 0.81], np.float32)
_AROUND_PX: Final = 30  # half the square whose disparities a filled one may be any of
_NOWHERE: Final = np.float32(1e9)  # beyond any image


class FillingMatcher:
    """Fills the disparities of another matcher; a `Matcher`."""

    def __init__(self, matcher: Matcher, threads: int | None = None) -> None:
        self._matcher = matcher
        self._threads = max(1, threads or os.cpu_count() or 1)

    def match(self, pair: RectifiedPair) -> Disparity:
        return fill(pair, self._matcher.match(pair), self._threads)


def fill(pair: RectifiedPair, seen: Disparity, threads: int) -> Disparity:
    """Return a disparity with planes of segments where there was none, or an unlikely one.

    Such pixels are FILLED. Where planes lead to nothing that was seen around a pixel, or it is
    hidden in the right view, all stays as it was.
    """
    if not seen.valid.any():
        return seen
    planes = np.full((SEGMENTATIONS, 3, *seen.values.shape), np.nan, np.float32)
    with ThreadPoolExecutor(threads) as pool:
        fit_segments(smooth_colours(pair), seen, planes, pool, threads)
    kept = np.isin(seen.reason, (Reason.BORDER, Reason.FILLED))
    wanted = (seen.confidence < _UNLIKELY) & ~kept
    filled, values = np.zeros_like(wanted), seen.values.copy()
    low, high = _ends_around(values)
    low = np.maximum(low - SAME_SURFACE_PX, np.nanmin(values))  # nothing beyond what was searched
    high = np.minimum(high + SAME_SURFACE_PX, np.nanmax(values))
    for value in planes[:, 0]:  # those of the smallest segments first
        taken = wanted & ~filled & (value >= low) & (value <= high) & ~outside(value)
        values[taken] = value[taken]
        filled |= taken
    hidden = np.empty_like(filled)
    there = np.where(np.isfinite(values), values, _NOWHERE)
    mark_hidden(there, SAME_SURFACE_PX, 0, len(values), hidden)
    filled &= ~(hidden & (seen.reason == np.uint8(Reason.OCCLUDED)))
    agreeing = (np.abs(planes[:, 0] - values) <= SAME_SURFACE_PX).sum(axis=0).clip(1)
    return Disparity(
        values=np.where(filled, values, seen.values),
        confidence=np.where(filled, _CONFIDENCE[agreeing - 1], seen.confidence),
        sigma_px=np.where(filled, spread(seen.values), seen.sigma_px),
        reason=np.where(filled, np.uint8(Reason.FILLED), seen.reason),
    )


def outside(values: Float32) -> Bool:
    """Return where disparities (H, W) lead beyond the right image."""
    width = values.shape[1]
    there = np.arange(width, dtype=np.float32) - values
    return np.asarray((there < -0.5) | (there > width - 0.5))


def spread(values: Float32) -> Float32:
    """Return the standard deviation of a disparity that is anywhere among those around it.

    float32 (H, W); of a uniform distribution from the least to the largest value around a pixel,
    and at least that of a flat minimum. Where none is around, of the whole map.
    """
    low, high = _ends_around(values)
    sigma = np.maximum((high - low) / np.sqrt(12), SIGMA_LARGEST_PX)
    return np.asarray(sigma, dtype=np.float32)


def _ends_around(values: Float32) -> tuple[Float32, Float32]:
    """Return the least and the largest disparity around each pixel; of the whole map if none is."""
    known = np.isfinite(values)
    seen = values[known] if known.any() else np.zeros(1, np.float32)
    side = np.ones((2 * _AROUND_PX + 1,) * 2, np.uint8)
    high = cv2.dilate(np.where(known, values, np.float32(-np.inf)), side)
    low = cv2.erode(np.where(known, values, np.float32(np.inf)), side)
    none = low > high
    return np.where(none, seen.min(), low), np.where(none, seen.max(), high)
