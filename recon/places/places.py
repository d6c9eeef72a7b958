"""The places of a drive: which may be near by odometry, which look alike, and loops that agree."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from os import PathLike
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import angle_rad, apply, invert
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64, freeze

_LONGEST_RUN: Final = 256  # images: half a million words, which merge in 50 ms and 10 MB
_BETWEEN: Final = 3.0  # path between two places of a segment that are compared, in reaches
_REACH: Final = 0.5  # fraction of the depth of what is seen, within which most of it is seen, too
_APART: Final = 0.5  # fraction of that distance which is between two candidates
VIEW_DEG: Final = 45.0  # largest angle between viewing directions that see enough in common


@dataclass(frozen=True, eq=False)
class Place:
    """What is kept in memory of a keyframe."""

    frame: int  # its frame
    T_world_camera: Float64  # (4, 4), by odometry
    path_m: float  # path up to it, by `path_lengths`
    segment: int  # of the drive that it belongs to: nothing is known between segments
    reach_m: float  # distance at which other places see enough in common
    words: NDArray[np.uint32]  # uint32 (W,), sorted, each once


class Places:
    """All places so far, in order; a query among thousands takes some milliseconds.

    ``scale`` is that of the scene, of which drift depends.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self._scale = scale
        self.frames: list[int] = []
        self.T_world_camera: Float64 = np.empty((0, 4, 4))
        self.path_m: Float64 = np.empty(0)
        self.segments: NDArray[np.int64] = np.empty(0, np.int64)  # that each belongs to
        self._words = WordIndex()

    def __len__(self) -> int:
        return len(self.frames)

    def add(self, place: Place) -> None:
        self.frames.append(place.frame)
        self.T_world_camera = np.concatenate([self.T_world_camera, place.T_world_camera[None]])
        self.path_m = np.append(self.path_m, place.path_m)
        self.segments = np.append(self.segments, place.segment)
        self._words.add(place.words)

    def near(self, place: Place) -> Bool:
        """Return bool (N,), those of its segment that drift allows to be in view of a later one."""
        way_m = place.path_m - self.path_m
        sigma_m, sigma_rad = spread_over(np.maximum(way_m, 0.0), self._scale)
        T = invert(self.T_world_camera) @ place.T_world_camera
        far_m = np.linalg.norm(T[:, :3, 3], axis=1) - SIGMAS * sigma_m
        turned = angle_rad(T) - SIGMAS * sigma_rad
        near = (far_m <= place.reach_m) & (turned <= np.deg2rad(VIEW_DEG))
        before = way_m >= _BETWEEN * place.reach_m
        return np.asarray(near & before & (self.segments == place.segment))

    def around(self, number: int, T_place_camera: Float64, reach_m: float) -> list[int]:
        """Return the places of a place's segment in view of a camera beside it, nearest first."""
        T = invert(self.T_world_camera) @ self.T_world_camera[number] @ T_place_camera
        far_m = np.linalg.norm(T[:, :3, 3], axis=1)
        near = (far_m <= reach_m) & (angle_rad(T) <= np.deg2rad(VIEW_DEG))
        found = np.flatnonzero(near & (self.segments == self.segments[number]))
        nearest: list[int] = found[np.argsort(far_m[found], kind="stable")].tolist()
        return nearest

    def likeness(self, place: Place) -> Float64:
        """Return float64 (N,), similarity of each to a place, in [0, 1]."""
        return self._words.likeness(place.words)


def reach_of(depth_m: NDArray[Any]) -> float:
    """Return the distance at which others see enough of what is seen at depths, NaN = unknown."""
    return _REACH * float(np.nanmedian(depth_m)) if np.isfinite(depth_m).any() else 0.0


def most_alike(
    likeness: Float64, worth: NDArray[np.intp], stands_m: Float64, reach_m: float
) -> Iterator[int]:
    """Yield images that are ``worth`` it, most similar first, each apart from those before."""
    chosen: list[int] = []
    for number in worth[np.argsort(-likeness[worth], kind="stable")].tolist():
        gaps_m = np.linalg.norm(stands_m[chosen] - stands_m[number], axis=1)
        if gaps_m.min(initial=np.inf) >= _APART * reach_m:
            chosen.append(number)
            yield number


@dataclass(frozen=True, eq=False)
class _Run:
    """The sorted words of consecutive images, with the image of each."""

    first: int  # number of the first image
    count: int  # number of images
    words: NDArray[np.uint32]  # uint32 (W,), sorted
    owners: NDArray[np.uint16]  # uint16 (W,), image of each word, counted from the first

    def followed_by(self, other: _Run) -> _Run:
        words = np.concatenate([self.words, other.words])
        owners = np.concatenate([self.owners, other.owners + np.uint16(self.count)])
        # The stable sort detects the two sorted runs and merges them.
        order = np.argsort(words, kind="stable")
        return _Run(self.first, self.count + other.count, words[order], owners[order])

    def find(self, words: NDArray[np.uint32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return int64 (K,), (K,), where the images have each word: from one number to another."""
        begin, end = (np.searchsorted(self.words, words, side) for side in ("left", "right"))
        return begin, end

    def shared(self, begin: NDArray[np.intp], end: NDArray[np.intp], weight: Float64) -> Float64:
        """Return float64 (count,), the summed weights of words that each image has."""
        found = end - begin
        before = np.cumsum(found) - found
        places = np.arange(found.sum()) + np.repeat(begin - before, found)
        summed = np.bincount(self.owners[places], np.repeat(weight, found), self.count)
        return summed.astype(np.float64)


class WordIndex:
    """An inverted index: which images have which words.

    Runs of sorted words are merged when they have the same size, as in a binary counter, up to a
    size that still merges in little time and memory.

    Ref: O'Neil et al., "The log-structured merge-tree", Acta Informatica 1996.
    """

    def __init__(self) -> None:
        self._sizes: list[int] = []
        self._runs: list[_Run] = []

    def add(self, words: NDArray[np.uint32]) -> None:
        """Add the distinct, sorted words of the next image."""
        run = _Run(len(self._sizes), 1, np.asarray(words), np.zeros(len(words), np.uint16))
        self._sizes.append(len(words))
        while self._runs and self._runs[-1].count == run.count < _LONGEST_RUN:
            run = self._runs.pop().followed_by(run)
        self._runs.append(run)

    def likeness(self, words: NDArray[np.uint32]) -> Float64:
        """Return float64 (N,), shared words of each image and another one, normalised to [0, 1].

        Words that many images have count for less (Spärck Jones, 1972).
        """
        count = len(self._sizes)
        ranges = [run.find(words) for run in self._runs]
        having = sum((end - begin for begin, end in ranges), np.zeros(len(words), np.intp))
        weight = np.log((count + 1.0) / np.maximum(having, 1)) / math.log(max(count, 1) + 1.0)
        shared = np.zeros(count)
        for run, found in zip(self._runs, ranges, strict=True):
            shared[run.first : run.first + run.count] = run.shared(*found, weight)
        sizes = np.sqrt(np.array(self._sizes, np.float64) * len(words))
        return np.divide(shared, sizes, out=np.zeros(len(shared)), where=sizes > 0)


# Lengths are those on a road: they are times the scale of the scene (`scene.scale`).
_LOST_FACTOR: Final = 20.0  # metres that one metre of extrapolated path counts as
_LOST_M: Final = 2.0  # path that is added for each frame without a measurement
SIGMAS: Final = 3.5  # largest possible deviation from odometry, in standard deviations
SHARE: Final = 0.02  # standard deviation of a position, as a fraction of the path
TURN_DEG: Final = 0.15
"""Standard deviation of the heading after 1 m; it grows with the root of the path."""


@dataclass(frozen=True)
class Drift:
    """Standard deviations of a motion by odometry."""

    position_m: float  # of its translation
    angle_rad: float  # of its rotation

    @property
    def covariance(self) -> Float64:
        """float64 (6, 6) of a step: translation in metres, rotation vector in radians."""
        return np.diag([self.position_m**2] * 3 + [self.angle_rad**2] * 3)


def path_lengths(T_world_camera: Float64, trusted: Bool, scale: float = 1.0) -> Float64:
    """The path (N,) up to each frame; metres without a trusted pose count several times."""
    step_m = np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1)
    lost = ~trusted[1:]
    step_m = np.where(lost, _LOST_FACTOR * step_m + scale * _LOST_M, step_m)
    return np.concatenate([np.zeros(min(1, len(trusted))), np.cumsum(step_m)])


def drift_over(path_m: float, scale: float = 1.0) -> Drift:
    """The drift over a path.

    The scale error is constant and the heading a random walk. The position error of the latter is
    that of a straight drive, the worst case: ``turn·√(path³/3)``.
    """
    return Drift(*map(float, spread_over(np.array(path_m), scale)))


def spread_over(path_m: Float64, scale: float = 1.0) -> tuple[Float64, Float64]:
    """Return `drift_over` of many paths (N,): standard deviations of positions and of rotations."""
    turn = math.radians(TURN_DEG) / math.sqrt(scale)
    position_m = np.hypot(SHARE * path_m, turn * np.sqrt(path_m**3 / 3.0))
    return position_m, turn * np.sqrt(path_m)


def is_possible(T_difference: NDArray[np.float64], drift: Drift, other: Drift) -> bool:
    """Whether a motion differs from odometry's by no more than drift explains.

    ``T_difference`` is the inverse of odometry's motion times the other one.
    """
    sigma_m, sigma_rad = map(math.hypot, astuple(drift), astuple(other))
    near = float(np.linalg.norm(T_difference[:3, 3])) <= SIGMAS * sigma_m
    return near and float(angle_rad(T_difference)) <= SIGMAS * sigma_rad


RECEIVER_M: Final = 10.0
"""Standard deviation of a measured coordinate where no file states it: a receiver among houses."""

_OTHER_UNIT: Final = 3.0
"""A foot, the unit of surveys that is nearest to a metre, is 3.28 times shorter."""

_TINY: Final = 1e-12
_SHORTEST_M: Final = 0.1  # path below which nothing is a fraction of it


@dataclass(frozen=True)
class PathFit:
    """How positions fit a path."""

    rms_m: float  # how far they are apart after a rigid fit, root mean square
    scaled_m: float  # the same after a fit that also scales the path
    scale: float  # how many times as far from one another as those of the path the positions are
    most_m: float  # largest distance that drift and noise explain
    most_scaling: float  # largest difference of the scale from 1 that they explain

    @property
    def rescaled(self) -> bool:
        """Whether the scale is one that nothing explains."""
        return abs(self.scale - 1.0) > self.most_scaling

    @property
    def other_unit(self) -> bool:
        """Whether it is the same path, but in another unit; a scale that is off is none."""
        apart = abs(math.log(max(self.scale, _TINY)))
        return self.rescaled and self.scaled_m <= self.most_m and apart > math.log(_OTHER_UNIT)

    def check(self, where: str | PathLike[str], hint: str) -> None:
        """Refuse positions that neither drift nor noise explains."""
        if self.rms_m <= self.most_m and not self.rescaled:
            return
        least, most = max(0.0, 1.0 - self.most_scaling), 1.0 + self.most_scaling
        raise EvaluationError(
            "positions and trajectory differ by more than drift and noise explain",
            where=where,
            got=f"{self.rms_m:.3g} m (RMS), {self.scale:.3g} times as far from one another",
            expected=f"at most {self.most_m:.3g} m, {least:.2f} to {most:.2f} times",
            hint=hint,
        )


def fit_to_path(
    ours_m: Float64, position_m: Float64, drift_m: float, sigma_m: float = RECEIVER_M
) -> PathFit:
    """How measured positions (N, 3), in other axes, fit those of a path.

    ``drift_m`` is by how much the path may be off at its end, standard deviation.
    """
    rigid, scaled = (fit_points(ours_m, position_m, scaled=scaled) for scaled in (False, True))
    path_m = max(float(np.linalg.norm(np.diff(ours_m, axis=0), axis=1).sum()), _SHORTEST_M)
    spread_m = max(_apart_m(ours_m, ours_m.mean(axis=0)), _SHORTEST_M)
    return PathFit(
        rms_m=_apart_m(apply(rigid.T_to_from, ours_m), position_m),
        scaled_m=_apart_m(apply(scaled.T_to_from, scaled.scale * ours_m), position_m),
        scale=scaled.scale,
        most_m=SIGMAS * math.hypot(drift_m, sigma_m),
        most_scaling=SIGMAS * math.hypot(drift_m / path_m, sigma_m / spread_m),
    )


def drift_at_end(
    path: Trajectory, trusted: Bool | None = None, stated_percent: float | None = None
) -> float:
    """By how much a path may be off at its end, standard deviation in metres.

    ``stated_percent`` is what its odometry states of its drift.
    """
    good = np.ones(len(path), np.bool_) if trusted is None else trusted
    length_m = float(path_lengths(path.T_world_camera, good)[-1])
    return max(drift_over(length_m).position_m, (stated_percent or 0.0) / 100.0 * length_m)


def _apart_m(ones: Float64, others: Float64) -> float:
    """How far points (N, 3) are from others, root mean square."""
    return float(np.sqrt(np.mean(np.sum((ones - others) ** 2, axis=-1))))


@dataclass(frozen=True, eq=False)
class Loop:
    """Two frames that show the same place, and the motion between them."""

    first: int  # number of the earlier frame
    last: int  # number of the later frame
    T_first_last: Float64  # (4, 4)
    # float64 (6, 6) of a step (translation in metres, rotation vector in radians) in the axes of
    # the later frame
    information: Float64
    inliers: int  # matches that agree in both frames
    dense_ratio: float  # fraction of the coarse disparities that agree
    same_frame: bool = False  # whether the two are one frame, in two recordings that overlap

    def __post_init__(self) -> None:
        freeze(self, "T_first_last", np.float64, (4, 4))
        freeze(self, "information", np.float64, (6, 6))


Poses: TypeAlias = Mapping[int, tuple[Float64, float, int]]
"""For each keyframe its pose by odometry, the path up to it, and the segment of the drive that it
belongs to: nothing is known between segments."""


def loop_sigmas(scale: float) -> Drift:
    """Return standard deviations of a verified loop, added to the drift: small, but never zero."""
    return Drift(0.3 * scale, np.deg2rad(1.0))


MIN_AGREEING: Final = 3  # loops that must agree, no two between the same keyframes
_NEAR_M: Final = 12.0  # path on a road within which neighbouring loops are compared
_MAJORITY: Final = 2  # keyframes whose loops confirm one, for each whose loop contradicts it


def agreeing_loops(
    loops: Sequence[Loop],
    firsts: Poses,
    lasts: Poses,
    *,
    keyframes: int = MIN_AGREEING,
    scale: float = 1.0,
) -> list[Loop]:
    """The verified loops that enough others confirm, and few contradict.

    Two loops and the odometry between their ends form a cycle that must close within the drift over
    its two odometry sections. False loops would have to be wrong in the same way several times.
    Where a row of similar houses makes them so, right loops nearby contradict them: without a clear
    majority none is accepted. ``firsts`` and ``lasts`` give pose and path of the keyframes in which
    loops begin and end, which may have different axes; the path is 0 in a map without drift of its
    own. ``keyframes`` is the least number of later keyframes among loops that agree, ``scale`` that
    of the scene.
    """
    near_m, sigmas = scale * _NEAR_M, loop_sigmas(scale)

    def closes(one: Loop, other: Loop) -> bool:
        """Whether two loops agree within the drift of the odometry between them."""
        T_lasts, lasts_m = _between(one.last, other.last, lasts)
        T_firsts, firsts_m = _between(one.first, other.first, firsts)
        ring = invert(one.T_first_last) @ T_firsts @ other.T_first_last @ invert(T_lasts)
        return is_possible(ring, drift_over(lasts_m + firsts_m, scale), sigmas)

    paths_m = np.array([(firsts[loop.first][1], lasts[loop.last][1]) for loop in loops])
    between = np.array([(firsts[loop.first][2], lasts[loop.last][2]) for loop in loops])
    agreeing = []
    for number, loop in enumerate(loops):
        firsts_m, lasts_m = np.abs(paths_m - paths_m[number]).T
        near = np.flatnonzero((lasts_m <= near_m) & (between == between[number]).all(axis=1))
        rings = {k: closes(loop, loops[k]) for k in near.tolist()}
        # Counted by keyframes: how many views of a place each finds is chance.
        against = {loops[k].last for k, closed in rings.items() if not closed}
        # Loops to elsewhere on the path may contradict, but over that distance agree too easily.
        same = [loops[k] for k, closed in rings.items() if closed and firsts_m[k] <= near_m]
        behind = {other.last for other in same}
        enough = max(keyframes, _MAJORITY * len(against))
        if len(same) >= MIN_AGREEING and len(behind) >= enough:
            agreeing.append(loop)
    return agreeing


def _between(first: int, last: int, poses: Poses) -> tuple[Float64, float]:
    """``T_first_last`` by odometry, and the path between the two."""
    (T_world_first, from_m, _), (T_world_last, to_m, _) = poses[first], poses[last]
    return invert(T_world_first) @ T_world_last, abs(to_m - from_m)
