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

    def measured(window: TrackWindow) -> tuple[float, Float64] | None:
        halves = list(_halves(window)) if len(window.xyz_world) else []
        if min((int(half.sum()) for half in halves), default=0) < MIN_INLIERS:
            return None
        apart_m = [_length_m(window, half, camera) - _length_m(window, ~half, camera)
                   for half in halves]  # fmt: skip
        return _length_m(window, np.ones(len(window.xyz_world), np.bool_), camera), np.array(
            apart_m
        )

    with serial_algebra():
        found = [one for one in side_by_side(measured, windows, threads=FEW) if one is not None]
    if not found:
        return float("nan")
    apart = sum(apart_m for _, apart_m in found) / sum(length_m for length_m, _ in found)
    return 0.5 * float(np.abs(apart).max())


def _halves(window: TrackWindow) -> Iterator[Bool]:
    """Yield halves of the points (N,): the left, the upper and the farther ones."""
    middle = np.nansum(window.uvd, axis=0) / np.isfinite(window.uvd).sum(axis=0).clip(1)
    for place in middle.T:
        yield place < np.median(place)


def _length_m(window: TrackWindow, chosen: Bool, camera: RectifiedCamera) -> float:
    """Return how far the camera moved through a window, by some of its points."""
    part = TrackWindow(window.T_world_camera, window.uvd[:, chosen], window.xyz_world[chosen])
    first, last = adjust(part, camera).T_world_camera[[0, -1]]
    return float(np.linalg.norm((invert(first) @ last)[:3, 3]))
