"""Measures of single images, of series of images, and of features in motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.odometry.pose import find_consensus, fit_pose
from recon.sources.source import StereoSource
from recon.stereo.rectify.epipolar import EpipolarAlignment, align_epipolar
from recon.stereo.rectify.features import PairFeatures

_AROUND_PX: Final = 9  # half of these may be saturated before their median is
_DARK: Final = 12.0
_BRIGHT: Final = 243.0
_SAME_DN: Final = 0.05  # two exposures of a static scene differ more, by sensor noise
_GAP_PERIODS: Final = 1.7  # time step, in frame periods, above which frames count as missing
_MIN_POINTS: Final = 20
_MIN_DISPARITY_PX: Final = 2.0
_AGREE_PX: Final = 2.0
MIN_FEATURES: Final = 60  # minimum number of features, in all, to judge geometry
LARGEST_SKEW: Final = 0.75  # a larger skew, in frames, is closer to an offset of one frame
_IN_STEP: Final = 0.8  # fraction of features that agree on one rotation, of images of one moment
_MIN_FLOW_PX: Final = 1.0  # rows per frame by which features must move to reveal a time skew


def measure_gain(left: UInt8, right: UInt8, left_uv: Float32, right_uv: Float32) -> Float64:
    """Return float64 (M,), brightness of the right image relative to the left, around features.

    Features whose surroundings are mostly black or saturated are left out.
    """
    first, second = _medians(left, left_uv), _medians(right, right_uv)
    fair = (np.minimum(first, second) > _DARK) & (np.maximum(first, second) < _BRIGHT)
    return np.asarray(second[fair] / first[fair], dtype=np.float64)


def _medians(image: UInt8, uv: Float32) -> Float64:
    smooth = cv2.medianBlur(np.ascontiguousarray(image), _AROUND_PX)
    height, width = image.shape
    column = np.clip(np.rint(uv[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(uv[:, 1]).astype(int), 0, height - 1)
    return np.asarray(smooth[row, column], dtype=np.float64)


def measure_sharpness(image: UInt8) -> float:
    """Return the fraction of the finest detail in all detail of a grey image, in [0, 1].

    Blur reduces the Laplacian at full size, but not at a quarter of it.
    """
    fine = image.astype(np.float32)
    coarse = cv2.resize(fine, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    finest = _detail(fine)
    total = finest + _detail(np.asarray(coarse))
    return finest / total if total > 0 else 0.0


def _detail(image: Float32) -> float:
    """Return mean of the strongest 5 % of absolute Laplacians, minus twice the median of all."""
    size = np.abs(cv2.Laplacian(image, cv2.CV_32F))
    noise, strong = np.quantile(size, [0.5, 0.95])
    return float(max(0.0, size[size >= strong].mean() - 2.0 * noise))


@dataclass
class RepeatCounter:
    """Counts repeats in a series of pairs."""

    steps: int = 0  # number of pairs compared with the previous pair
    both: int = 0  # number of steps in which neither image changed
    # longest run of steps in which only the (left, right) image did not change
    frozen: list[int] = field(default_factory=lambda: [0, 0])
    _run: list[int] = field(default_factory=lambda: [0, 0])
    _last: tuple[UInt8, UInt8] | None = None

    def join(self, later: RepeatCounter) -> None:
        """Add what was counted in a later series."""
        self.steps, self.both = self.steps + later.steps, self.both + later.both
        self.frozen = [max(sides) for sides in zip(self.frozen, later.frozen, strict=True)]

    def add(self, left: UInt8, right: UInt8) -> None:
        if self._last is not None:
            self.steps += 1
            same = [
                now.shape == last.shape and bool(cv2.absdiff(now, last).mean() < _SAME_DN)
                for now, last in zip((left, right), self._last, strict=True)
            ]
            self.both += all(same)
            for side in range(2):
                alone = same[side] and not same[1 - side]
                self._run[side] = self._run[side] + 1 if alone else 0
                self.frozen[side] = max(self.frozen[side], self._run[side])
        self._last = (left, right)


def track(now: UInt8, then: UInt8, uv: Float32) -> tuple[Float32, Bool]:
    """Track features (N, 2) from one image to the next (Lucas-Kanade).

    Returns their places there, and bool (N,), True where tracking back returns to the start.
    """
    if not len(uv):
        return uv, np.zeros(0, np.bool_)
    there, found, _ = cv2.calcOpticalFlowPyrLK(now, then, uv[:, None], None, winSize=(21, 21))
    back, again, _ = cv2.calcOpticalFlowPyrLK(then, now, there, None, winSize=(21, 21))
    near = np.abs(back.reshape(-1, 2) - uv).max(axis=1) < 0.5
    return there.reshape(-1, 2), np.asarray((found.ravel() > 0) & (again.ravel() > 0) & near)


def measure_speed(
    left_uv: Float32, right_uv: Float32, later_uv: Float32, camera: RectifiedCamera
) -> float | None:
    """Return how far the rig moves between two frames, metres; None if too few features agree.

    ``later_uv`` is where the features (N, 2) are in the left image of the next frame.
    """
    disparity = left_uv[:, 0] - right_uv[:, 0] + camera.doffs_px
    near = disparity > _MIN_DISPARITY_PX
    if near.sum() < _MIN_POINTS:
        return None
    depth_m = camera.focal_px * camera.baseline_m / disparity[near].astype(np.float64)
    rays = np.linalg.inv(camera.matrix) @ np.vstack([left_uv[near].T, np.ones(near.sum())])
    xyz = (rays * depth_m).T
    uv, enough = later_uv[near].astype(np.float64), max(_MIN_POINTS, math.ceil(0.4 * near.sum()))
    found = find_consensus(xyz, uv, camera, limit_px=_AGREE_PX, iterations=100, min_inliers=enough)
    if found is None:
        return None
    T = fit_pose(xyz[found.agree], uv[found.agree], camera)
    return float(np.linalg.norm(T[:3, 3]))


def measure_time_skew(
    epipolar_error_px: Float64, row_flow_px: Float64
) -> tuple[float, float] | None:
    """Return the delay of the right camera in frames, and its standard error; None if unknown.

    It is the slope of the epipolar error (right minus left, (N,)) over the rows that features move by in
    a frame, as a late camera sees them moved on.
    """
    moving = np.abs(row_flow_px) > _MIN_FLOW_PX
    if moving.sum() < _MIN_POINTS:
        return None
    flow, error = row_flow_px[moving], epipolar_error_px[moving]
    weight = np.ones(len(flow))
    slope = 0.0
    for _ in range(10):
        slope = float(np.sum(weight * flow * error) / np.sum(weight * flow * flow))
        residual = error - slope * flow
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
        weight = np.where(np.abs(residual) < 3 * scale, 1.0, 0.0)
    kept = weight > 0
    variance = float(np.mean((error - slope * flow)[kept] ** 2)) / float(np.sum(flow[kept] ** 2))
    return slope, float(np.sqrt(variance))


@dataclass(frozen=True)
class Gaps:
    """Missing frames, from the timestamps of all pairs."""

    count: int = 0  # number of gaps; 0 if the timestamps are not known in advance
    longest_s: float = float("nan")  # longest time step
    after: int = 0  # frame before that step
    usual_s: float = float("nan")  # median time step; NaN if unknown


def find_gaps(source: StereoSource) -> Gaps:
    """Find time steps that are too long, in sources with known timestamps."""
    steps = np.zeros(0) if source.stamps_s is None else np.diff(source.stamps_s)
    usual_s = float(np.median(steps)) if len(steps) else 0.0
    if usual_s <= 0:
        return Gaps()
    after = int(np.argmax(steps))
    count = int(np.count_nonzero(steps > _GAP_PERIODS * usual_s))
    return Gaps(count, float(steps[after]), after, usual_s)


def align_features(features: PairFeatures, camera: RectifiedCamera) -> EpipolarAlignment | None:
    """Fit the rotation that aligns the rows of features; None if too few agree."""
    if len(features) < MIN_FEATURES:
        return None
    found = align_epipolar(features.left_uv, features.right_uv, camera)
    return found if found is not None and found.agreeing >= MIN_FEATURES else None


def time_skew(
    pairs: Sequence[PairFeatures],
    flows: Sequence[Float64],
    camera: RectifiedCamera,
    alignment: EpipolarAlignment | None,
) -> tuple[float, float] | None:
    """Return the skew in frames with its standard error, from features of pairs and their flow."""
    if alignment is None:
        return None
    errors, moving = [np.zeros(0)], [np.zeros(0)]
    for features, flow in zip(pairs, flows, strict=True):
        rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
        # The skew is at most half a frame, so a larger epipolar error means a wrong match.
        known = np.isfinite(flow) & (np.abs(rows) < 1.5 + 0.5 * np.abs(flow))
        errors.append(rows[known])
        moving.append(flow[known])
    return measure_time_skew(np.concatenate(errors), np.concatenate(moving))


def in_step(features: PairFeatures, flow: Float64, camera: RectifiedCamera) -> bool:
    """Return whether moving features show that both images are of one moment, of no other frame.

    They agree on one rotation, and their rows do not move on with the flow.
    """
    alignment = align_features(features, camera)
    if alignment is None or alignment.agreeing < _IN_STEP * len(features):
        return False
    skew = time_skew([features], [flow], camera, alignment)
    return skew is not None and abs(skew[0]) + 4 * skew[1] < 1 - LARGEST_SKEW
