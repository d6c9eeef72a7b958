"""Beside steps of depth: disparities that a window took from the other side are taken back."""

from __future__ import annotations

from concurrent.futures import Executor
from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Bool, Float32
from recon.stereo.kernels import steps as kernels
from recon.stereo.match import search as common
from recon.stereo.match.segments import SAME_SURFACE_PX

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
    doubted = Disparity(seen.values, _doubted(seen.confidence, own), seen.sigma_px, seen.reason)
    return doubted.reject(own < 0, Reason.EDGE)


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
    own = np.empty(values.shape, np.float32)

    def take(rows: range) -> None:
        kernels.take_votes(values, grey, alike, marked, vote, rows.start, rows.stop, own)

    common.in_strips(pool, _STRIPS, take, len(values))
    return own


def beyond_range(seen: Disparity) -> Bool:
    """Return where the costs of most pixels had their minimum at the limit of what was searched.

    Minima of noise lie there now and then; those of the sky, nearly all.
    """
    at_limit = (seen.reason == np.uint8(Reason.OUT_OF_RANGE)).astype(np.uint8)
    return np.asarray((cv2.medianBlur(at_limit, _NEIGHBOURS_PX) > 0) & ~seen.valid)


def _doubted(confidence: Float32, own: Float32) -> Float32:
    """Return confidences whose odds fall with the fraction of votes against a disparity."""
    kept = np.exp(-_DOUBT * (1 - np.clip(own, 0, 1))).astype(np.float32)
    return np.asarray(confidence * kept / (1 - confidence * (1 - kept)), np.float32)
