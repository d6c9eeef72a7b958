"""What was not measured, inferred from planes of the segments around it, where these have evidence.

An inferred disparity needs a plane that matches lie on all around, and on a good part of its
segment; none where the costs had their minimum at the limit of what was searched: there is what is
nearer than that, or the sky.
"""

from __future__ import annotations

import os
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from typing import Final

import cv2
import numpy as np

from recon.core.kernels.compiled import UInt16
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Bool, Float32, UInt8
from recon.stereo.kernels import evidence as kernels
from recon.stereo.kernels.planes import mark_hidden
from recon.stereo.kernels.refine import SIGMA_LARGEST_PX
from recon.stereo.match import search as common
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.segments import SAME_SURFACE_PX, SEGMENTATIONS, fit_segments, smooth_colours
from recon.stereo.match.steps import beyond_range, vote_at_steps

_UNLIKELY: Final = 0.5  # below this confidence a disparity is more likely wrong than right
_TRUSTED: Final = 0.7  # from this confidence on it speaks for or against a plane
_CLIPPED_PX: Final = 5  # edge of the square whose mean is black or white
_CLIPPED_LEVELS: Final = 4  # grey levels that noise adds to black
_WIDEST_GAP: Final = 3  # neighbouring directions without support: less than a half-plane
_LEAST_RATIO: Final = 0.3  # of a segment that lies on its plane, unless it is supported all around
# Of what such planes led to on MiddEval3, dmb4, the yard and rendered scenes, so much was right.
_CONFIDENCE: Final = 0.88
_AROUND_PX: Final = 30  # half the square whose disparities a filled one may be any of
_NOWHERE: Final = np.float32(1e9)  # beyond any image


class FillingMatcher:
    """Settles what another matcher found by what the image looks like; a `Matcher`.

    What its windows, which reach ``reach`` pixels, took across a step is taken back, and what can
    be inferred is added.
    """

    def __init__(self, matcher: Matcher, reach: int, threads: int | None = None) -> None:
        self._matcher, self._reach = matcher, reach
        self._threads = max(1, threads or os.cpu_count() or 1)

    def match(self, pair: RectifiedPair) -> Disparity:
        seen = self._matcher.match(pair)
        if self._reach:
            with ThreadPoolExecutor(self._threads) as pool:
                seen = vote_at_steps(pair, seen, self._reach, pool)
        return fill(pair, seen, self._threads)


def fill(pair: RectifiedPair, seen: Disparity, threads: int) -> Disparity:
    """Return a disparity with planes of segments where there was none, or an unlikely one.

    Such pixels are FILLED. Where no plane has enough evidence, or it is hidden in the right view,
    all stays as it was. Where the image is black or white there is nothing to match: what was found
    there is rejected (`Reason.LOW_TEXTURE`).
    """
    clipped = _clipped(pair.left)
    seen = seen.reject(clipped, Reason.LOW_TEXTURE)
    sure = seen.measured & (seen.confidence >= _UNLIKELY)
    if not sure.any():
        return seen
    planes = np.full((SEGMENTATIONS, 3, *sure.shape), np.nan, np.float32)
    trusted = seen.reject(~seen.measured | (seen.confidence < _TRUSTED), Reason.AMBIGUOUS)
    unseen = beyond_range(seen) | clipped | (seen.reason == np.uint8(Reason.BORDER))
    filled, values = np.zeros_like(sure), seen.values.copy()
    with ThreadPoolExecutor(threads) as pool:
        ratios = fit_segments(smooth_colours(pair), trusted, planes, pool, threads)
        distances = _distances(trusted.measured, pool)
        for plane, ratio in zip(planes, ratios, strict=True):  # the smallest segments first
            wanted = ~(sure | filled | unseen | outside(plane[0]))
            support = np.empty((3, *sure.shape), np.uint8)
            weigh = partial(_weigh, seen.values, distances, plane, wanted, support)
            common.in_strips(pool, threads, weigh, len(sure))
            taken = (ratio >= _LEAST_RATIO) & (support[2] <= _WIDEST_GAP) & (support[1] == 0)
            taken |= support[0] == kernels.DIRECTIONS
            values[taken] = plane[0][taken]
            filled |= taken
    hidden = np.empty_like(filled)
    there = np.where(np.isfinite(values), values, _NOWHERE)
    mark_hidden(there, SAME_SURFACE_PX, 0, len(values), hidden)
    filled &= ~(hidden & (seen.reason == np.uint8(Reason.OCCLUDED)))
    return Disparity(
        values=np.where(filled, values, seen.values),
        confidence=np.where(filled, np.float32(_CONFIDENCE), seen.confidence),
        sigma_px=np.where(filled, spread(seen.values), seen.sigma_px),
        reason=np.where(filled, np.uint8(Reason.FILLED), seen.reason),
    )


def _clipped(grey: UInt8) -> Bool:
    """Return where an image is black or white, but for noise: it shows nothing there."""
    level = cv2.blur(grey, (_CLIPPED_PX, _CLIPPED_PX))
    return np.asarray((level < _CLIPPED_LEVELS) | (level > 255 - _CLIPPED_LEVELS))


def _distances(known: Bool, pool: Executor) -> UInt16:
    """Return the steps to the next known pixel in each direction, uint16 (8, H, W)."""
    distances = np.empty((kernels.DIRECTIONS, *known.shape), np.uint16)
    jobs = [
        pool.submit(kernels.find_nearest, known, direction, of)
        for direction, of in enumerate(distances)
    ]
    for job in jobs:
        job.result()
    return distances


def _weigh(
    values: Float32, distances: UInt16, planes: Float32, wanted: Bool, to: UInt8, rows: range
) -> None:
    kernels.weigh_planes(
        values, distances, planes, wanted, SAME_SURFACE_PX, rows.start, rows.stop, to
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
