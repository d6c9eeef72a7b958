"""What was not measured, inferred from planes of the segments around it, where these have evidence.

An inferred disparity needs a plane that matches lie on all around, and on a good part of its
segment; none where the costs had their minimum at the limit of what was searched: there is what is
nearer than that, or the sky. Segments are parts of an image that no edge divides, at several sizes
of an edge: what windows cannot tell in the middle of a plain wall, its rim and its few marks can.

Before that, what a window took from the other side of a step of depth is taken back.
"""

from __future__ import annotations

import os
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Final

import cv2
import numpy as np

from recon.core.geometry.alignment import nearest_sorted
from recon.core.kernels.compiled import UInt16
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Bool, Float32, UInt8, frozen_array
from recon.stereo.kernels import filling as kernels
from recon.stereo.kernels.planes import mark_hidden
from recon.stereo.kernels.refine import SIGMA_LARGEST_PX
from recon.stereo.match import search as common
from recon.stereo.match.protocol import Matcher

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
    level = cv2.blur(pair.left, (_CLIPPED_PX, _CLIPPED_PX))
    clipped = (level < _CLIPPED_LEVELS) | (level > 255 - _CLIPPED_LEVELS)
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
            given = seen.values, distances, plane, wanted, SAME_SURFACE_PX
            common.run_kernel(pool, threads, len(sure), kernels.weigh_planes, given, support)
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


def _distances(known: Bool, pool: Executor) -> UInt16:
    """Return the steps to the next known pixel in each direction, uint16 (8, H, W)."""
    distances = np.empty((kernels.DIRECTIONS, *known.shape), np.uint16)
    find = partial(kernels.find_nearest, known)
    list(pool.map(find, range(kernels.DIRECTIONS), distances))
    return distances


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
    known = np.isfinite(values)
    seen = values[known] if known.any() else np.zeros(1, np.float32)
    side = np.ones((2 * _AROUND_PX + 1,) * 2, np.uint8)
    high = cv2.dilate(np.where(known, values, np.float32(-np.inf)), side)
    low = cv2.erode(np.where(known, values, np.float32(np.inf)), side)
    none = low > high
    low, high = np.where(none, seen.min(), low), np.where(none, seen.max(), high)
    sigma = np.maximum((high - low) / np.sqrt(12), SIGMA_LARGEST_PX)
    return np.asarray(sigma, dtype=np.float32)


_LEVELS: Final = 8.0  # difference of grey levels at which the weight of a vote falls to 1/e
_VOTERS: Final = 3  # half the square of voters, in reaches of a window: what it spoilt, and as much
_STRIDE: Final = 3  # of voters: the disparities of neighbours are of the same window
_SLOPE: Final = 0.05  # disparities per pixel, of a surface whose pixels vote alike
# Fitted on scenes of MiddEval3, the yard, dmb4 and rendered ones: by how much the logarithm of the
# odds of a disparity is less, if none of the votes are for it.
_DOUBT: Final = 2.5
_BEYOND: Final = np.float32(-1e9)  # the disparity of no surface
_NEIGHBOURS_PX: Final = 5  # a reason is that of most of such a square
_STRIPS: Final = 8  # of rows, which threads share: one strip may have all the steps


def vote_at_steps(pair: RectifiedPair, seen: Disparity, reach: int, pool: Executor) -> Disparity:
    """Return a disparity without what the image says is of the other side of a step.

    Within ``reach`` pixels of a step pixels vote on a disparity by how alike they look; those that
    are beyond the range, such as the sky, for none. Where another surface has more votes it is
    rejected (`Reason.EDGE`); of what stays, the confidence falls with the fraction of the votes
    against it.
    """
    own = _count_votes(pair, np.where(beyond_range(seen), _BEYOND, seen.values), reach, pool)
    # The odds of a disparity fall with the fraction of votes against it.
    kept = np.exp(-_DOUBT * (1 - np.clip(own, 0, 1))).astype(np.float32)
    sure = np.asarray(seen.confidence * kept / (1 - seen.confidence * (1 - kept)), np.float32)
    return replace(seen, confidence=sure).reject(own < 0, Reason.EDGE)


def _count_votes(pair: RectifiedPair, values: Float32, reach: int, pool: Executor) -> Float32:
    """Return the fraction of the votes for each disparity within ``reach`` of a step, else 1.

    float32 (H, W); negative where another surface has more.
    """
    marked, across = np.zeros(values.shape, np.uint8), np.zeros(values.T.shape, np.uint8)
    kernels.mark_steps(values, reach, SAME_SURFACE_PX, marked)
    kernels.mark_steps(np.ascontiguousarray(values.T), reach, SAME_SURFACE_PX, across)
    marked |= across.T
    grey = np.asarray(cv2.blur(pair.left, (3, 3)), np.uint8)  # without the noise of single pixels
    alike = np.exp(np.arange(256) / -_LEVELS).astype(np.float32)
    vote = kernels.Vote(_VOTERS * reach, _STRIDE, SAME_SURFACE_PX, _SLOPE)
    own, given = np.empty(values.shape, np.float32), (values, grey, alike, marked, vote)
    common.run_kernel(pool, _STRIPS, len(values), kernels.take_votes, given, own)
    return own


def beyond_range(seen: Disparity) -> Bool:
    """Return where the costs of most pixels had their minimum at the limit of what was searched.

    Minima of noise lie there now and then; those of the sky, nearly all.
    """
    at_limit = (seen.reason == np.uint8(Reason.OUT_OF_RANGE)).astype(np.uint8)
    return np.asarray((cv2.medianBlur(at_limit, _NEIGHBOURS_PX) > 0) & ~seen.valid)


_EDGES: Final = (3, 6, 12, 24)
"""Differences of neighbouring colours, over three channels, above which there is an edge: from the
noise of a good image to what divides any two surfaces. Which is right differs within one image, so
the planes of all are offered."""
SEGMENTATIONS: Final = len(_EDGES)
SAME_SURFACE_PX: Final = 1.0  # disparities that are farther apart are of two surfaces
_LEAST_PX: Final = 100  # smaller segments have the planes of windows
_TRIES: Final = 150  # planes through three pixels: one of them is right where a third lies on it


def fit_segments(
    guide: UInt8, seen: Disparity, to: Float32, pool: Executor, threads: int
) -> Float32:
    """Write the planes of the pixels in segments that have one, (SEGMENTATIONS, 3, H, W).

    ``guide``, uint8 (H, W, 3), are smoothed colours. What was seen counts by its confidence.
    Returns which fraction of the segment of a pixel lies on its plane, float32 (SEGMENTATIONS, H,
    W).
    """
    ratios = np.zeros((SEGMENTATIONS, *guide.shape[:2]), np.float32)
    # By how much each pixel differs from those above and to the left, over the channels.
    steps = np.zeros(guide.shape[:2], np.uint16)
    steps[1:] = cv2.absdiff(guide[1:], guide[:-1]).sum(axis=2, dtype=np.uint16)
    beside = cv2.absdiff(guide[:, 1:], guide[:, :-1]).sum(axis=2, dtype=np.uint16)
    steps[:, 1:] = np.maximum(steps[:, 1:], beside)
    draws = np.random.default_rng(0).random((_TRIES, 3))
    for edge, planes, ratio in zip(_EDGES, to, ratios, strict=True):
        alike = (steps <= edge).view(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(alike, connectivity=4)
        sizes = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
        starts, order = np.concatenate([[0], np.cumsum(sizes)]), np.empty(steps.size, np.int64)
        kernels.sort_by_label(labels.ravel(), starts, order)
        wanted = np.flatnonzero(sizes >= _LEAST_PX)
        wanted = wanted[wanted > 0]  # 0 are edges
        if len(wanted):
            given = seen.values, seen.confidence, order, starts, wanted, draws, SAME_SURFACE_PX
            count, fit = len(wanted), kernels.fit_segments
            common.run_kernel(pool, threads, count, fit, given, planes, ratio)
    return ratios


def smooth_colours(pair: RectifiedPair) -> UInt8:
    """Return the colours of the left view, uint8 (H, W, 3), without the noise of single pixels."""
    colours = pair.left_rgb
    if colours is None:
        colours = np.repeat(pair.left[..., None], 3, axis=2)
    return np.asarray(cv2.blur(colours, (3, 3)), dtype=np.uint8)


def fill_holes(values: Float32) -> Float32:
    """Give each pixel without a disparity that of the background beside it: float32 (H, W).

    That is the smaller of the nearest values to the left and to the right, or the only one. A row
    without any is copied from the nearest row with some, the upper one of two.

    Ref: the background interpolation of A. Geiger et al., KITTI stereo development kit.
    """
    values = frozen_array("values", values, np.float32, (None, None))
    known = np.isfinite(values)
    background = np.fmin(_from_left(values), _from_left(values[:, ::-1])[:, ::-1])
    filled = np.where(known, values, background)
    rows = np.flatnonzero(known.any(axis=1))
    return filled[rows[nearest_sorted(np.arange(len(filled)), rows)]] if rows.size else filled


def _from_left(values: Float32) -> Float32:
    """Return float32 (H, W): the nearest known value at or left of each; NaN = none."""
    columns = np.where(np.isfinite(values), np.arange(values.shape[1], dtype=np.int32), -1)
    last = np.maximum.accumulate(columns, axis=1)
    there = np.take_along_axis(values, np.maximum(last, 0).astype(np.intp), axis=1)
    return np.where(last >= 0, there, np.float32(np.nan))
