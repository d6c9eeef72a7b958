"""Geometric verification of loops."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.core.values.camera import project
from recon.places.align import MIN_INLIERS, Alignment, Seen, find_motion, refine_motion
from recon.places.keyframe import (
    Keyframe,
    coarse_grid,
    coarse_points,
    feature_sigma_px,
    points_of,
)
from recon.places.loop import Loop

_CELLS: Final = 4
_MAX_HAMMING: Final = 72  # largest Hamming distance of a match
_GUIDED_HAMMING: Final = 90  # that of features that are where they should be
_GUIDED_SIGMAS: Final = 4.0  # how far they may be from there
_SPREAD_CELLS: Final = 5  # of 4 by 4 cells of each image, how many must hold inliers
_MAX_SIGMA_M: Final = 0.3  # loops less certain than this, on a road, in any direction are refused
_DENSE_TOLERANCE_PX: Final = 1.0
"""Largest difference between a predicted and a seen disparity that agree."""

_DENSE_TOLERANCE_RATIO: Final = 0.03  # fraction of the disparity that is added to it
_MIN_DENSE_RATIO: Final = 0.75  # least fraction of the dense points that agree
_MIN_DENSE_POINTS: Final = 50  # least number of dense points that both frames see


@dataclass(frozen=True, eq=False)
class Verdict:
    """The result of a verification."""

    loop: Loop | None  # the loop; None = refused
    refused: str = ""  # why; "" where there is a loop


def verify(
    first: Keyframe,
    last: Keyframe,
    camera: RectifiedCamera,
    first_camera: RectifiedCamera | None = None,
    scale: float = 1.0,
) -> Verdict:
    """Whether two keyframes show the same place.

    Matches must be mutually best. The motions found in either direction must be inverse to each
    other. The inliers must be many, a fair fraction of the matches, spread over both images, and
    determine the motion in all directions. The coarse disparities must agree with it, too.
    """
    cameras = (first_camera or camera, camera)
    aligned = _aligned(Matchable.of(first, cameras[0]), Matchable.of(last, cameras[1]), scale)
    if isinstance(aligned, str):
        return Verdict(None, aligned)
    T, inliers = aligned.T_first_last, int(aligned.agree.sum())
    dense = dense_agreement(first, last, T, *cameras)
    if dense < _MIN_DENSE_RATIO:
        return Verdict(None, "surfaces differ")
    return Verdict(Loop(first.frame, last.frame, T, aligned.information, inliers, dense))


def _aligned(first: Matchable, last: Matchable, scale: float) -> Alignment | str:
    """The motion between the frames, or why it is not verified."""
    found = find_motion(*_seen(first, last, first.mutual(last)))
    if found is None:
        return "no common motion"
    near = match_near(first, last, found.T_first_last)
    if near is None:
        return "few inliers"
    pairs, aligned = near
    if min(_spread(one) for one in _seen(first, last, pairs)) < _SPREAD_CELLS:
        return "inliers in one corner"
    if _sigma_m(aligned.information) > scale * _MAX_SIGMA_M:
        return "motion not fixed"
    return aligned


def match_near(
    first: Matchable, last: Matchable, T_first_last: Float64
) -> tuple[NDArray[np.intp], Alignment] | None:
    """Return the features (M, 2) that agree on a motion near a given one, and it; None = too few.

    Where it is known where features should be, fewer have to be told apart.
    """
    pairs = first.guided(last, T_first_last)
    aligned = refine_motion(*_seen(first, last, pairs), T_first_last)
    if aligned is None or int(aligned.agree.sum()) < MIN_INLIERS:
        return None
    return pairs[aligned.agree], aligned


@dataclass(frozen=True, eq=False)
class Matchable:
    """The features of a keyframe that have a depth."""

    uvd: Float64  # (N, 3), column, row, disparity
    xyz: Float64  # (N, 3), in camera axes
    descriptors: UInt8  # (N, 32)
    camera: RectifiedCamera

    @staticmethod
    def of(keyframe: Keyframe, camera: RectifiedCamera) -> Matchable:
        known = np.isfinite(keyframe.uvd[:, 2])
        uvd = keyframe.uvd[known].astype(np.float64)
        return Matchable(uvd, points_of(uvd, camera), keyframe.descriptors[known], camera)

    def mutual(self, other: Matchable) -> NDArray[np.intp]:
        """Return int (M, 2), features that are each other's best match."""
        if not len(self.uvd) or not len(other.uvd):
            return np.zeros((0, 2), np.intp)
        found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        pairs = [
            (match.queryIdx, match.trainIdx)
            for match in found.match(self.descriptors, other.descriptors)
            if match.distance <= _MAX_HAMMING
        ]
        return np.array(pairs, np.intp).reshape(-1, 2)

    def guided(self, other: Matchable, T_self_other: Float64) -> NDArray[np.intp]:
        """Return int (M, 2), for features the other's best match near where a motion takes it."""
        u, v, _ = project(apply(T_self_other, other.xyz), self.camera)
        radius_px = _GUIDED_SIGMAS * feature_sigma_px(self.camera)
        with np.errstate(invalid="ignore"):
            near = (self.uvd[:, :1] - u) ** 2 + (self.uvd[:, 1:2] - v) ** 2 <= radius_px**2
        rows, columns = np.nonzero(near)
        bits = np.full(near.shape, 8 * _GUIDED_HAMMING)
        differ = self.descriptors[rows] ^ other.descriptors[columns]
        bits[rows, columns] = np.bitwise_count(differ).sum(axis=1)
        best, best_back = bits.argmin(axis=1), bits.argmin(axis=0)
        ours = np.flatnonzero(best_back[best] == np.arange(len(best)))
        ours = ours[bits[ours, best[ours]] <= _GUIDED_HAMMING]
        return np.column_stack([ours, best[ours]])


def _seen(first: Matchable, last: Matchable, pairs: NDArray[np.intp]) -> tuple[Seen, Seen]:
    ones, others = (
        Seen(k.uvd[rows], k.xyz[rows], k.camera, feature_sigma_px(k.camera))
        for k, rows in zip((first, last), pairs.T, strict=True)
    )
    return ones, others


def dense_agreement(
    first: Keyframe,
    last: Keyframe,
    T_first_last: Float64,
    first_camera: RectifiedCamera,
    last_camera: RectifiedCamera,
) -> float:
    """The fraction of coarse disparities that the other frame confirms, in the worse direction.

    A smaller disparity than predicted means seeing through the other's surface: a contradiction. A
    larger one means that something is in front of it, which does not count. 0 where the two frames
    hardly overlap.
    """
    return min(
        _confirmed(coarse_points(last.coarse, last_camera), first, T_first_last, first_camera),
        _confirmed(
            coarse_points(first.coarse, first_camera), last, invert(T_first_last), last_camera
        ),
    )


def _confirmed(
    xyz: Float64, target: Keyframe, T_target_source: Float64, camera: RectifiedCamera
) -> float:
    """The fraction of points of another frame that the target sees where they should be."""
    u, v, d = project(apply(T_target_source, xyz), camera)
    step, half = coarse_grid(target.coarse, camera)
    off = _interpolated(target.coarse, (u - half) / step, (v - half) / step) - d
    tolerance = _DENSE_TOLERANCE_PX + _DENSE_TOLERANCE_RATIO * np.abs(d)
    with np.errstate(invalid="ignore"):
        comparable = off <= tolerance  # False for NaN, unknown in one of the frames
    if int(comparable.sum()) < _MIN_DENSE_POINTS:
        return 0.0
    return float(np.mean(off[comparable] >= -tolerance[comparable]))


def _interpolated(values: Float32, column: Float64, row: Float64) -> Float64:
    """Values (N,) between samples; NaN beyond them, or where one of the four is unknown."""
    rows, columns = values.shape
    with np.errstate(invalid="ignore"):
        inside = (column >= 0) & (column < columns - 1) & (row >= 0) & (row < rows - 1)
    x, y = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
    i, j = y.astype(np.intp), x.astype(np.intp)
    i1, j1 = np.minimum(i + 1, rows - 1), np.minimum(j + 1, columns - 1)
    x, y = x - j, y - i
    upper = (1 - x) * values[i, j] + x * values[i, j1]
    lower = (1 - x) * values[i1, j] + x * values[i1, j1]
    return np.where(inside, (1 - y) * upper + y * lower, np.nan)


def _spread(seen: Seen) -> int:
    """Return how many of 4 by 4 cells of the image hold a feature."""
    uvd, camera = seen.uvd, seen.camera
    column = np.clip(uvd[:, 0] * _CELLS / camera.width_px, 0, _CELLS - 1).astype(int)
    row = np.clip(uvd[:, 1] * _CELLS / camera.height_px, 0, _CELLS - 1).astype(int)
    return len(np.unique(row * _CELLS + column))


def _sigma_m(information: Float64) -> float:
    """The deviation of the translation in its worst direction; infinity = unknown."""
    values = np.linalg.eigvalsh(information)
    if values[0] <= 1e-9 * values[-1]:
        return float("inf")
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)[:3, :3])[-1]))
