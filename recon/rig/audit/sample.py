"""Sampling of a drive for an audit, and the stereo geometry that its features show together.

Stretches of frames are read, and in some of their pairs features are matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import ReconError
from recon.core.progress import tracked
from recon.core.values import RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float32, Float64
from recon.rig.audit.measures import (
    RepeatCounter,
    measure_gain,
    measure_sharpness,
    measure_speed,
    measure_time_skew,
    track,
)
from recon.sources.source import StereoSource
from recon.stereo.rectify.features import (
    NO_FEATURES,
    PairFeatures,
    inspect_features,
    match_features,
    pool_features,
)
from recon.stereo.rectify.rectifier import Rectifier
from recon.stereo.rectify.row_alignment import RowAlignment, align_rows, count_aligned

Sides = tuple[float, float]  # of the left and of the right image
_QUICK_RUNS = 2  # stretches of a quick audit, just long enough to detect a delayed camera
_LAG_PAIRS = 4  # pairs that are also compared at other lags
_QUICK_REACH = 300  # a quick audit stays near the start: a video is decoded up to each frame
_LEAST_SIDE_PX = 16  # smaller images have no features, and no sharpness
FRAMES: Final = 300  # frames that are read in all
_RUNS: Final = 6  # number of runs of consecutive frames on longer drives
_PAIRS: Final = 12  # pairs in which features are matched
_FEATURES: Final = 1500  # maximum number of features per image
_QUICK_FEATURES: Final = 800  # the same in a quick audit
_MAX_LAG: Final = 4  # largest delay of one camera to look for, in frames
_QUICK_LAG: Final = 3  # the same in a quick audit
BLANK_DN: Final = 4.0  # an image counts as blank below this standard deviation, in grey levels
_LAG_FACTOR: Final = 1.25  # agreement relative to lag 0 from which a delay is reported
_ALIKE: Final = 1.5  # agreement of the best lag relative to another that fits about as well
_LARGEST_SKEW: Final = 0.75  # a larger skew, in frames, is closer to a lag of one frame
MIN_FEATURES: Final = 60  # minimum number of features, in all, to judge geometry


@dataclass(frozen=True, eq=False)
class Look:
    """What was measured in one pair."""

    index: int  # number of the pair
    brightness_dn: Sides  # mean grey levels
    sharpness: Sides  # shares of the finest detail; NaN if unknown
    features: PairFeatures  # matched features
    pair: RectifiedPair | None  # the images; None where they are not kept

    @property
    def rows_px(self) -> Float64:
        """float64 (N,): row of each feature in the right image minus that in the left one."""
        apart = self.features.right_uv[:, 1] - self.features.left_uv[:, 1]
        return apart.astype(np.float64)


class _Lagged(NamedTuple):
    """A pair at a lag: its matched features, their `Sample.flows`, how many agree on a rotation."""

    features: PairFeatures
    flow: Float64
    agreeing: int


@dataclass(eq=False)
class Sample:
    """Measures of the sampled images; lists have an entry for each measured pair."""

    frames: int = 0  # number of pairs that were read
    repeats: RepeatCounter = field(default_factory=RepeatCounter)
    contrast_dn: list[Sides] = field(default_factory=list)  # standard deviations of grey levels
    brightness_dn: list[Sides] = field(default_factory=list)  # mean grey levels
    sharpness: list[Sides] = field(default_factory=list)  # shares of the finest detail
    gains: list[Float64] = field(default_factory=list)  # brightness ratios around features
    features: list[PairFeatures] = field(default_factory=list)  # matched features
    # by how many frames after the left image the right image is taken from
    lagged: dict[int, list[_Lagged]] = field(default_factory=dict)
    speeds_m_per_s: list[float] = field(default_factory=list)  # of the rig, where measured
    # (N,), rows by which each feature moves to the next frame; NaN if unknown
    flows: list[Float64] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)  # each pair; a few of them with their images
    broken: ReconError | None = None  # the error that ended the sampling, if any


def take_sample(source: StereoSource, rectifier: Rectifier, *, quick: bool) -> Sample:
    """Sample a drive; an error of a pair ends the sampling and is kept in ``broken``."""
    stretches = plan_stretches(len(source), FRAMES, quick=quick)
    centres = plan_centres(stretches, quick=quick)
    sampler = _Sampler(source, rectifier, centres, quick=quick)
    try:
        for start, stop in tracked(stretches, "windows", "check the recording"):
            sampler.look(start, stop)
    except ReconError as error:
        sampler.sample.broken = error
    return sampler.sample


def plan_stretches(frames: int, read: int, *, quick: bool) -> list[tuple[int, int]]:
    """Return first frame and end of each stretch of a drive; ``read`` frames are read in all."""
    frames = min(frames, _QUICK_REACH) if quick else frames
    runs = _QUICK_RUNS if quick else _RUNS
    length = 2 * _QUICK_LAG + 1 if quick else max(2, read // runs)
    if frames <= runs * length:
        return [(0, frames)]
    # In the middle of equal parts, since a drive may begin and end at rest.
    starts = [int((k + 0.5) * frames / runs - length / 2) for k in range(runs)]
    return [(start, start + length) for start in starts]


def plan_centres(stretches: list[tuple[int, int]], *, quick: bool) -> list[int]:
    """Return frames whose features are matched, evenly spread, with a margin for the lags."""
    pairs, lag = (_QUICK_RUNS, _QUICK_LAG) if quick else (_PAIRS, _MAX_LAG)
    each = max(1, pairs // len(stretches))
    chosen: list[int] = []
    for start, stop in stretches:
        # On a short drive, several pairs with a few lags are better than one pair with all.
        margin = min(lag, (stop - start - 1) // (2 if quick else 3))
        places = np.linspace(start + margin, stop - 1 - margin, each)
        chosen += sorted({int(place) for place in np.rint(places)})
    return chosen


class _Sampler:
    """Reads stretches, keeping the pairs around the current one."""

    def __init__(
        self, source: StereoSource, rectifier: Rectifier, centres: list[int], *, quick: bool
    ) -> None:
        self.sample = Sample()
        self._source, self._rectifier = source, rectifier
        self._lag = _QUICK_LAG if quick else _MAX_LAG
        self._features = _QUICK_FEATURES if quick else _FEATURES
        self._centres = centres
        # The first, middle and last pair are kept; all would not fit into memory.
        self._kept = {centres[n] for n in (0, len(centres) // 2, -1)} if centres else set()
        self._with_lag = set(centres[:: max(1, len(centres) // _LAG_PAIRS)])
        self._recent: dict[int, RectifiedPair] = {}

    def look(self, start: int, stop: int) -> None:
        """Read one stretch; a pair is measured once its neighbours have been read."""
        self.sample.repeats.restart()
        self._recent.clear()
        waiting = [centre for centre in self._centres if start <= centre < stop]
        recordings = islice(self._source.frames(start), stop - start)
        for number, recorded in enumerate(recordings, start):
            self.sample.frames += 1
            self.sample.repeats.add(recorded.left, recorded.right)
            # A pair, or part of a drive, may have its numbers from elsewhere.
            pair = replace(self._rectifier.rectify(recorded), index=number)
            self._recent[pair.index] = pair
            self._recent.pop(pair.index - 2 * self._lag - 1, None)
            while waiting and pair.index >= min(waiting[0] + self._lag, stop - 1):
                self._measure(waiting.pop(0))

    def _measure(self, centre: int) -> None:
        pair, sample = self._recent[centre], self.sample
        sample.contrast_dn.append((float(pair.left.std()), float(pair.right.std())))
        sample.brightness_dn.append((float(pair.left.mean()), float(pair.right.mean())))
        kept = pair if pair.index in self._kept else None
        look = Look(pair.index, sample.brightness_dn[-1], (np.nan, np.nan), NO_FEATURES, kept)
        if min(sample.contrast_dn[-1]) < BLANK_DN:
            sample.looks.append(look)
            return
        if min(pair.left.shape) < _LEAST_SIDE_PX:
            sample.features.append(NO_FEATURES)
            sample.flows.append(np.zeros(0))
            return
        sample.sharpness.append((measure_sharpness(pair.left), measure_sharpness(pair.right)))
        features = match_features(pair.left, pair.right, self._features)
        sample.features.append(features)
        sample.looks.append(replace(look, sharpness=sample.sharpness[-1], features=features))
        seen = (features.left_uv, features.right_uv)
        sample.gains.append(measure_gain(pair.left, pair.right, *seen))
        if centre in self._with_lag:
            self._compare_lags(centre, features)
        self._measure_motion(centre, features)

    def _compare_lags(self, centre: int, features: PairFeatures) -> None:
        span = min(self._lag, centre - min(self._recent), max(self._recent) - centre)
        pair, sample = self._recent[centre], self.sample
        for lag in range(-span, span + 1):
            found = features
            if lag:
                right = self._recent[centre + lag].right
                found = match_features(pair.left, right, self._features)
            agreeing = count_aligned(found.left_uv, found.right_uv, pair.camera)
            flow, _ = self._follow(centre, found)
            sample.lagged.setdefault(lag, []).append(_Lagged(found, flow, agreeing))

    def _measure_motion(self, centre: int, features: PairFeatures) -> None:
        flow, there = self._follow(centre, features)
        self.sample.flows.append(flow)
        found, later = np.isfinite(flow), self._recent.get(centre + 1)
        if later is not None:
            pair = self._recent[centre]
            seen = (features.left_uv[found], features.right_uv[found], there[found])
            moved_m = measure_speed(*seen, pair.camera)
            step_s = later.timestamp_s - pair.timestamp_s
            if moved_m is not None and step_s > 0:
                self.sample.speeds_m_per_s.append(moved_m / step_s)

    def _follow(self, centre: int, features: PairFeatures) -> tuple[Float64, Float32]:
        """Return rows by which features move to the next frame, NaN = unknown, and their places."""
        flow, there = np.full(len(features), np.nan), features.left_uv
        later = self._recent.get(centre + 1)
        if later is not None and len(features):
            there, found = track(self._recent[centre].left, later.left, features.left_uv)
            flow[found] = there[found, 1] - features.left_uv[found, 1]
        return flow, there


@dataclass(frozen=True, eq=False)
class Geometry:
    """Stereo geometry measured from the features of a drive."""

    pairs: int  # whose features were matched
    features: PairFeatures  # of all pairs; if one camera is delayed, of pairs shifted by the lag
    matched: int  # number of features matched in pairs as recorded
    alignment: RowAlignment | None  # row errors; None if there are too few features
    disparity_px: Float64  # (M,), of the features whose rows agree; 0 is at infinity
    swapped_share: float  # of near features, farther right in the right image; NaN = too few
    out_of_step: bool  # whether images of other moments fit better
    lag: int  # delay of the right camera in whole frames
    # its delay in parts of a frame, and the standard error; None if unknown, or whole frames
    skew: tuple[float, float] | None


def measure_geometry(sample: Sample, camera: RectifiedCamera) -> Geometry:
    """Measure the geometry from the features of all pairs."""
    features = pool_features(sample.features)
    matched = len(features)
    alignment = _align(features, camera)
    skew = _time_skew(sample.features, sample.flows, camera, alignment)
    lag = _best_lag(sample, skew, camera)
    if lag:
        features, skew = pool_features(each.features for each in sample.lagged[lag]), None
        alignment = _align(features, camera)
    return Geometry(
        pairs=len(sample.features),
        features=features,
        matched=matched,
        alignment=alignment,
        disparity_px=_disparities(features, alignment, camera),
        swapped_share=inspect_features(features, camera.doffs_px, MIN_FEATURES).negative_share,
        out_of_step=bool(lag) or _best_fit(sample)[1] > _LAG_FACTOR,
        lag=lag,
        skew=skew,
    )


def _align(features: PairFeatures, camera: RectifiedCamera) -> RowAlignment | None:
    if len(features) < MIN_FEATURES:
        return None
    found = align_rows(features.left_uv, features.right_uv, camera)
    return found if found is not None and found.agreeing >= MIN_FEATURES else None


def _disparities(
    features: PairFeatures, alignment: RowAlignment | None, camera: RectifiedCamera
) -> Float64:
    if alignment is None:
        return np.zeros(0)
    rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
    shift = features.left_uv[:, 0] - features.right_uv[:, 0] + camera.doffs_px
    return shift[np.abs(rows) < max(1.0, 3 * alignment.residual_px)].astype(np.float64)


def _best_lag(sample: Sample, skew: tuple[float, float] | None, camera: RectifiedCamera) -> int:
    """Return the lag that fits best, if it fits clearly better than none.

    A delay of half a frame fits both neighbours badly; it is a skew, which moving features show.
    """
    best, times = _best_fit(sample)
    best = _best_moving(sample, best, camera)
    if abs(best) == 1:
        found, flows, _ = zip(*sample.lagged[best], strict=True)
        left = _time_skew(found, flows, camera, _align(pool_features(found), camera))
        if left is not None:
            return best if abs(left[0]) < 1 - _LARGEST_SKEW else 0
        if skew is not None and 4 * skew[1] < abs(skew[0]) < _LARGEST_SKEW:
            return 0
    return best if times > _LAG_FACTOR else 0


def _best_moving(sample: Sample, best: int, camera: RectifiedCamera) -> int:
    """Return of the lags that fit about as well as the best one that at which moving rows do best.

    Where little moves, or what is ahead comes nearer, neighbouring frames match as well.
    """
    fit = {lag: sum(n.agreeing for n in at) / len(at) for lag, at in sample.lagged.items()}
    sigmas = {}
    for lag in (lag for lag in fit if _ALIKE * fit[lag] >= fit[best]):
        found, flows, _ = zip(*sample.lagged[lag], strict=True)
        skew = _time_skew(found, flows, camera, _align(pool_features(found), camera))
        if skew is not None and abs(skew[0]) < 1 - _LARGEST_SKEW:
            sigmas[lag] = skew[1]
    return min(sigmas, key=lambda lag: sigmas[lag], default=best)


def _best_fit(sample: Sample) -> tuple[int, float]:
    """Return the lag that fits best, and how many times as well as none; 1 if few features do."""
    # Lags were tried on different numbers of pairs.
    total = {lag: sum(n.agreeing for n in at) for lag, at in sample.lagged.items()}
    fit = {lag: number / len(sample.lagged[lag]) for lag, number in total.items()}
    best = max(fit, key=lambda lag: (fit[lag], -abs(lag)), default=0)
    if total.get(best, 0) < MIN_FEATURES:
        return best, 1.0
    return best, fit[best] / max(fit.get(0, 0.0), 1.0)


def _time_skew(
    pairs: Sequence[PairFeatures],
    flows: Sequence[Float64],
    camera: RectifiedCamera,
    alignment: RowAlignment | None,
) -> tuple[float, float] | None:
    """Return the skew in frames with its standard error, from features of pairs and their flow."""
    if alignment is None:
        return None
    errors, moving = [np.zeros(0)], [np.zeros(0)]
    for features, flow in zip(pairs, flows, strict=True):
        rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
        # The skew is at most half a frame, so a larger row error means a wrong match.
        known = np.isfinite(flow) & (np.abs(rows) < 1.5 + 0.5 * np.abs(flow))
        errors.append(rows[known])
        moving.append(flow[known])
    return measure_time_skew(np.concatenate(errors), np.concatenate(moving))
