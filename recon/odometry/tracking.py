"""Tracking of features from image to image, and their disparity."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity
from recon.core.values.arrays import Bool, Float32, UInt8
from recon.stereo.rectify.features import exposed_as

_WINDOW_PX: Final = 17
"""Edge of the tracked patch."""

_LEVELS: Final = 3
"""Pyramid levels above full resolution."""

_MAX_EXPOSURE_CHANGE: Final = 0.05
"""Relative change of brightness or contrast above which an image is adapted to the exposure of the
last one before tracking."""

_NEIGHBOUR_PX: Final = 2
"""Half width of the neighbourhood whose median is the disparity."""

_MAX_DISPARITY_STEP_PX: Final = 1.0
"""Largest difference between a disparity and that median."""

_MIN_EIGENVALUE: Final = 1e-4
"""Least texture of a patch that is tracked, OpenCV's scale."""


def follow(source: UInt8, target: UInt8, uv: Float32, guess_uv: Float32) -> tuple[Float32, Bool]:
    """Track features to another image, roughly: as patches that look the same.

    Args:
        source: Image in which the features are known.
        target: Image to which they are tracked.
        uv: float32 (N, 2), columns and rows in ``source``.
        guess_uv: float32 (N, 2), predicted columns and rows in ``target``.

    Returns:
        float32 (N, 2), columns and rows in ``target``, and bool (N,), True where something was
        found; part of it is wrong.

    Ref:
        Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2001.
    """
    if not len(uv):
        return uv.copy(), np.zeros(0, np.bool_)
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.05)
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        _comparable(source, target),
        uv.reshape(-1, 1, 2),
        guess_uv.reshape(-1, 1, 2).copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=end,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_MIN_EIGENVALUE,
    )
    there, found = there.reshape(-1, 2), status.ravel().astype(np.bool_)
    height, width = target.shape
    inside = (there >= 0).all(axis=1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    return there, np.asarray(found & inside)


def _comparable(source: UInt8, target: UInt8) -> UInt8:
    """Return the target, adapted to the exposure of the source if the two differ."""
    ours, theirs = (np.ravel(cv2.meanStdDev(image)) for image in (source, target))
    same = np.abs(theirs - ours) <= _MAX_EXPOSURE_CHANGE * ours
    return target if same.all() else exposed_as(source, target)


def sample_disparity(disparity: Disparity, uv: Float32) -> Float32:
    """Return the matcher's disparity of features: the median around each, where that is consistent.

    Tracking features into the right image instead gave two to four times the drift on real
    drives, probably because patches at the edge of an object contain the background, too.

    Args:
        disparity: The matcher's result.
        uv: float32 (N, 2), features of the left image.

    Returns:
        float32 (N,), pixels; NaN where there is no match, or one unlike its neighbours.
    """
    height, width = disparity.values.shape
    column, row = np.rint(uv).astype(np.int64).T
    offset = np.arange(-_NEIGHBOUR_PX, _NEIGHBOUR_PX + 1)
    columns = np.clip(column[:, None, None] + offset, 0, width - 1)
    rows = np.clip(row[:, None, None] + offset[:, None], 0, height - 1)
    around = disparity.values[rows, columns].reshape(len(uv), offset.size**2)
    centre = around[:, around.shape[1] // 2]
    around = np.where(np.isfinite(around), around, centre[:, None])
    middle = np.median(around, axis=1)
    agrees = np.abs(middle - centre) <= _MAX_DISPARITY_STEP_PX
    sampled: Float32 = np.where(agrees, middle, np.nan).astype(np.float32)
    return sampled
