"""Which frames of a drive a look reads, and what is measured in them.

In single images, in series of images, and of features in motion.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Final, NamedTuple

import cv2
import numpy as np

from recon.core.errors import ReconError
from recon.core.values import Recorded, Rectified, RectifiedCamera, RectifiedPair, StereoPair
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.look.tracks import REACH, TRACKED, tracked_parts
from recon.odometry.pose import find_consensus, fit_pose
from recon.sources.source import StereoSource
from recon.stereo.rectify.epipolar import EpipolarAlignment, align_epipolar, count_aligned
from recon.stereo.rectify.features import NO_FEATURES, PairFeatures, match_features
from recon.stereo.rectify.rectifier import Rectifier

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


def measure_mosaic(image: UInt8) -> float:
    """Return by how much pixels differ from neighbours, relative to those two pixels away.

    Below 1 in photographs, 1 in noise, above in a Bayer mosaic, whose colours are two pixels apart.
    """
    grey = (image if image.ndim == 2 else image[:, :, 1]).astype(np.int16)
    both = [[np.abs(one[by:] - one[:-by]).mean() for one in (grey, grey.T)] for by in (1, 2)]
    return float(min(both[0]) / max(*both[1], 1e-9))


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

    It is the slope of the epipolar error (right minus left, (N,)) over the rows that features move
    by in a frame, as a late camera sees them moved on.
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


Sides = tuple[float, float]  # of the left and of the right image
_KEPT: Final = 6  # pairs that are kept as recorded
_LEAST_SIDE_PX: Final = 16  # smaller images have no features, and no sharpness
_none: Final = partial(np.zeros, 0)
BLANK_DN: Final = 4.0  # an image counts as blank below this standard deviation, in grey levels


@dataclass(frozen=True)
class Extent:
    """How much of a drive is looked at."""

    frames: int  # that are read in all
    pairs: int  # in which features are matched
    features: int  # at most, per image
    offset: int  # largest delay of one camera to look for, in frames
    offset_pairs: int  # pairs that are also compared at other offsets
    margin: int  # of a window that is left for offsets at each end: one of so many parts
    whole: bool  # whether a drive is looked at that is longer than what is tracked


QUICK: Final = Extent(
    TRACKED, pairs=6, features=800, offset=3, offset_pairs=2, margin=2, whole=False
)
# In a short window, several pairs with a few offsets are better than one pair with all.
THOROUGH: Final = Extent(
    300, pairs=12, features=1500, offset=4, offset_pairs=4, margin=3, whole=True
)


class Window(NamedTuple):
    """Consecutive frames that are read: ``start`` to ``stop - 1``."""

    start: int
    stop: int
    tracked: tuple[int, int]  # first frame and end of the part whose motion is seen
    centres: tuple[int, ...]  # frames in which features are matched


def plan_windows(frames: int, extent: Extent) -> list[Window]:
    """Return the windows of a look at a drive, around its tracked parts; of a short one, all."""
    parts = tracked_parts(frames)
    if extent.whole and frames - REACH >= extent.frames // 2:
        after = np.linspace(REACH, frames, 2 * len(parts) + 1)[1::2].astype(int).tolist()
        parts += [(middle, middle) for middle in after]
    if frames <= extent.frames:
        between = [(before[1] + after[0]) // 2 for before, after in pairwise(parts)]
        spans = list(pairwise([0, *between, frames]))
    else:
        half = extent.frames // len(parts) // 2
        starts = [min(max(0, sum(part) // 2 - half), frames - 2 * half) for part in parts]
        spans = [(start, start + 2 * half) for start in starts]
    many = max(1, extent.pairs // len(parts))
    return [
        Window(start, stop, part, _centres(start, stop, many, extent))
        for (start, stop), part in zip(spans, parts, strict=True)
    ]


def _centres(start: int, stop: int, many: int, extent: Extent) -> tuple[int, ...]:
    """Return frames, evenly spread, with a margin for the offsets."""
    margin = min(extent.offset, (stop - start - 1) // extent.margin)
    places = np.rint(np.linspace(start + margin, stop - 1 - margin, many)).astype(int)
    return tuple(np.unique(places).tolist())


class Shifted(NamedTuple):
    """A pair at an offset: its matched features, their flow, how many agree on one rotation."""

    features: PairFeatures
    flow: Float64
    agreeing: int


@dataclass(frozen=True, eq=False)
class PairMeasures:
    """What was measured in one pair."""

    index: int  # number of the pair
    contrast_dn: Sides  # standard deviations of grey levels
    brightness_dn: Sides  # mean grey levels
    shown: RectifiedPair | None = None  # the images; None where they are not kept
    sharpness: Sides = (np.nan, np.nan)  # fractions of the finest detail; NaN if unknown
    gains: Float64 = field(default_factory=_none)  # brightness ratios around features
    features: PairFeatures = NO_FEATURES  # matched features
    # (N,), rows by which each moves to the next frame; NaN = unknown
    flow: Float64 = field(default_factory=_none)
    speed_m_per_s: float = np.nan  # of the rig; NaN if unknown
    # by how many frames after the left image the right image is taken from
    by_offset: Mapping[int, Shifted] = field(default_factory=dict)

    @property
    def epipolar_error_px(self) -> Float64:
        """float64 (N,): row of each feature in the right image minus that in the left one."""
        apart = self.features.right_uv[:, 1] - self.features.left_uv[:, 1]
        return apart.astype(np.float64)


@dataclass(eq=False)
class Sample:
    """What was measured in the pairs that were looked at."""

    frames: int = 0  # number of pairs that were read
    repeats: RepeatCounter = field(default_factory=RepeatCounter)
    pairs: list[PairMeasures] = field(default_factory=list)
    recorded: list[Recorded] = field(default_factory=list)  # a few pairs, as recorded
    broken: ReconError | None = None  # the error that ended the sampling, if any

    @classmethod
    def joined(cls, parts: Iterable[Sample]) -> Sample:
        """Return the measures of several windows together, as far as the first that is broken."""
        whole = cls()
        for part in parts:
            whole.frames += part.frames
            whole.repeats.join(part.repeats)
            whole.pairs += part.pairs
            whole.recorded += part.recorded
            whole.broken = part.broken
            if whole.broken is not None:
                break
        return whole

    @property
    def matched(self) -> list[tuple[PairFeatures, Float64]]:
        """Features and their flow, of each pair that is not uniform."""
        seen = (one for one in self.pairs if min(one.contrast_dn) >= BLANK_DN)
        return [(one.features, one.flow) for one in seen]

    @property
    def by_offset(self) -> dict[int, list[Shifted]]:
        """By offset, the pairs that were compared at it."""
        offsets = sorted({offset for one in self.pairs for offset in one.by_offset})
        return {
            offset: [one.by_offset[offset] for one in self.pairs if offset in one.by_offset]
            for offset in offsets
        }

    @property
    def sharpness(self) -> Float64 | None:
        """float64 (2,), median of the sharpness of both sides; None if unknown."""
        known = [one.sharpness for one in self.pairs if np.isfinite(one.sharpness).all()]
        return np.asarray(np.median(known, axis=0)) if known else None

    @property
    def gain(self) -> tuple[float, int]:
        """Median brightness of right images relative to left ones, of so many features."""
        gains = np.concatenate([np.zeros(0), *(one.gains for one in self.pairs)])
        return (float(np.median(gains)), len(gains)) if len(gains) else (np.nan, 0)

    @property
    def speed_m_per_s(self) -> float:
        """Median speed of the rig; NaN if unknown."""
        speeds = [one.speed_m_per_s for one in self.pairs if np.isfinite(one.speed_m_per_s)]
        return float(np.median(speeds)) if speeds else np.nan


class Chosen(NamedTuple):
    """Centres of which more is done than of others; all would not fit into memory."""

    shown: Container[int]  # whose rectified images are kept: the first, middle and last
    kept: Container[int]  # which are kept as recorded
    by_offset: Container[int]  # that are compared at other offsets, if need be


def choose(windows: Sequence[Window], extent: Extent) -> Chosen:
    """Choose centres of a look, evenly spread."""
    all_ = [centre for window in windows for centre in window.centres]
    shown = {all_[n] for n in (0, len(all_) // 2, -1)} if all_ else set()
    kept, by_offset = (set(all_[:: max(1, len(all_) // n)]) for n in (_KEPT, extent.offset_pairs))
    return Chosen(shown, kept, by_offset)


class Sampler:
    """Measures the pairs of one window, given in order."""

    def __init__(
        self, window: Window, rectifier: Rectifier, extent: Extent, chosen: Chosen
    ) -> None:
        self.sample = Sample()
        self._window, self._rectifier, self._effort = window, rectifier, extent
        self._chosen = chosen
        self._waiting = list(window.centres)
        self._recent: dict[int, RectifiedPair] = {}

    def add(self, number: int, recorded: Recorded, view: Rectified | None = None) -> None:
        """Add the next pair, and its rectified view if there is one.

        A pair is measured once its neighbours have been read.
        """
        self.sample.frames += 1
        if number in self._chosen.kept:
            self.sample.recorded.append(recorded)
        if not isinstance(recorded, StereoPair):  # it has no other image to compare with
            return
        self.sample.repeats.add(recorded.left, recorded.right)
        if not self._waiting:
            return
        offset = self._effort.offset
        if number >= self._waiting[0] - offset:
            # A pair, or part of a drive, may have its numbers from elsewhere.
            both = view if isinstance(view, RectifiedPair) else self._rectifier.rectify(recorded)
            self._recent[number] = replace(both, index=number)
        self._recent.pop(number - 2 * offset - 1, None)
        last = self._window.stop - 1
        while self._waiting and number >= min(self._waiting[0] + offset, last):
            self._measure(self._waiting.pop(0))

    def _measure(self, centre: int) -> None:
        pair = self._recent[centre]
        sides = (pair.left, pair.right)
        seen = PairMeasures(
            index=centre,
            contrast_dn=(float(pair.left.std()), float(pair.right.std())),
            brightness_dn=(float(pair.left.mean()), float(pair.right.mean())),
            shown=pair if centre in self._chosen.shown else None,
        )
        if min(seen.contrast_dn) >= BLANK_DN and min(pair.left.shape) >= _LEAST_SIDE_PX:
            features = match_features(*sides, self._effort.features)
            flow, speed = self._motion(centre, features)
            seen = replace(
                seen,
                sharpness=(measure_sharpness(pair.left), measure_sharpness(pair.right)),
                features=features,
                gains=measure_gain(*sides, features.left_uv, features.right_uv),
                flow=flow,
                speed_m_per_s=speed,
            )
            if centre in self._chosen.by_offset and not in_step(features, flow, pair.camera):
                seen = replace(seen, by_offset=self._offsets(centre, features))
        self.sample.pairs.append(seen)

    def _offsets(self, centre: int, features: PairFeatures) -> dict[int, Shifted]:
        span = min(self._effort.offset, centre - min(self._recent), max(self._recent) - centre)
        pair, offsets = self._recent[centre], dict[int, Shifted]()
        for offset in range(-span, span + 1):
            found = features
            if offset:
                right = self._recent[centre + offset].right
                found = match_features(pair.left, right, self._effort.features)
            agreeing = count_aligned(found.left_uv, found.right_uv, pair.camera)
            offsets[offset] = Shifted(found, self._follow(centre, found)[0], agreeing)
        return offsets

    def _motion(self, centre: int, features: PairFeatures) -> tuple[Float64, float]:
        """Return rows by which features move to the next frame, and the speed of the rig."""
        flow, there = self._follow(centre, features)
        found, later = np.isfinite(flow), self._recent.get(centre + 1)
        if later is None:
            return flow, np.nan
        pair = self._recent[centre]
        seen = (features.left_uv[found], features.right_uv[found], there[found])
        moved_m, step_s = measure_speed(*seen, pair.camera), later.timestamp_s - pair.timestamp_s
        return flow, moved_m / step_s if moved_m is not None and step_s > 0 else np.nan

    def _follow(self, centre: int, features: PairFeatures) -> tuple[Float64, Float32]:
        """Return rows by which features move to the next frame, NaN = unknown, and their places."""
        flow, there = np.full(len(features), np.nan), features.left_uv
        later = self._recent.get(centre + 1)
        if later is not None and len(features):
            there, found = track(self._recent[centre].left, later.left, features.left_uv)
            flow[found] = there[found, 1] - features.left_uv[found, 1]
        return flow, there
