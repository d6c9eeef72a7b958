"""By how much halves of the features of a drive disagree on how far it went.

The formal error of a path takes features as independent. What is left of the fault of a rig is not:
all that is on one side of the image, near, or low is off alike. So each window is adjusted twice,
with what lies on either side, above and below, near and far: estimates of one motion that share no
feature. Half of their difference is what the two together may be off by.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from recon.core.geometry.se3 import invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.core.work import FEW, serial_algebra, side_by_side
from recon.odometry.pose import MIN_INLIERS, TrackWindow, adjust


def disagreement(windows: Sequence[TrackWindow], camera: RectifiedCamera) -> float:
    """Return the standard deviation of a path's length by halves of the features, as a share.

    That of the halves that disagree most: what is near is low, too, so that theirs do not add up.
    ``windows`` are seen with the rig of the path; those with too few features to be halved do not
    count. NaN = there are no others.
    """

    def measured(window: TrackWindow) -> list[float]:
        every = np.ones(len(window.xyz_world), np.bool_)
        halves = list(_halves(window)) if every.any() else []
        if min((int(half.sum()) for half in halves), default=0) < MIN_INLIERS:
            return []
        lengths_m = [[_length_m(window, part, camera) for part in (half, ~half)] for half in halves]
        return [_length_m(window, every, camera), *(one - other for one, other in lengths_m)]

    with serial_algebra():
        found = [one for one in side_by_side(measured, windows, threads=FEW) if one]
    if not found:
        return float("nan")
    length_m, *apart_m = np.sum(found, axis=0)
    return 0.5 * float(np.abs(apart_m).max() / length_m)


def _halves(window: TrackWindow) -> Iterator[Bool]:
    """Yield halves of the points (N,): the left, the upper and the farther ones."""
    for place in middles(window).T:
        yield place < np.median(place)


def middles(window: TrackWindow) -> Float64:
    """Return where points are in the middle of their tracks: column, row, disparity (N, 3)."""
    return np.asarray(np.nansum(window.uvd, axis=0) / np.isfinite(window.uvd).sum(axis=0).clip(1))


def _length_m(window: TrackWindow, chosen: Bool, camera: RectifiedCamera) -> float:
    """Return how far the camera moved through a window, by some of its points."""
    part = TrackWindow(window.T_world_camera, window.uvd[:, chosen], window.xyz_world[chosen])
    first, last = adjust(part, camera).T_world_camera[[0, -1]]
    return float(np.linalg.norm((invert(first) @ last)[:3, 3]))
