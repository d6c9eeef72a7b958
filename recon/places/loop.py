"""A loop: a place that two frames show, of one drive or of two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from recon.core.geometry.se3 import invert
from recon.core.values.arrays import Float64, freeze
from recon.places.places import Drift, drift_over, is_possible


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
    poses, near_m = (firsts, lasts), scale * _NEAR_M
    paths_m = np.array([(firsts[loop.first][1], lasts[loop.last][1]) for loop in loops])
    between = np.array([(firsts[loop.first][2], lasts[loop.last][2]) for loop in loops])
    agreeing = []
    for number, loop in enumerate(loops):
        firsts_m, lasts_m = np.abs(paths_m - paths_m[number]).T
        near = np.flatnonzero((lasts_m <= near_m) & (between == between[number]).all(axis=1))
        rings = {k: _closes(loop, loops[k], poses, scale) for k in near.tolist()}
        # Counted by keyframes: how many views of a place each finds is chance.
        against = {loops[k].last for k, closes in rings.items() if not closes}
        # Loops to elsewhere on the path may contradict, but over that distance agree too easily.
        same = [loops[k] for k, closes in rings.items() if closes and firsts_m[k] <= near_m]
        behind = {other.last for other in same}
        enough = max(keyframes, _MAJORITY * len(against))
        if len(same) >= MIN_AGREEING and len(behind) >= enough:
            agreeing.append(loop)
    return agreeing


def _closes(one: Loop, other: Loop, poses: tuple[Poses, Poses], scale: float) -> bool:
    """Whether two loops agree within the drift of the odometry between them."""
    firsts, lasts = poses
    T_lasts, lasts_m = _between(one.last, other.last, lasts)
    T_firsts, firsts_m = _between(one.first, other.first, firsts)
    ring = invert(one.T_first_last) @ T_firsts @ other.T_first_last @ invert(T_lasts)
    return is_possible(ring, drift_over(lasts_m + firsts_m, scale), loop_sigmas(scale))


def _between(first: int, last: int, poses: Poses) -> tuple[Float64, float]:
    """``T_first_last`` by odometry, and the path between the two."""
    (T_world_first, from_m, _), (T_world_last, to_m, _) = poses[first], poses[last]
    return invert(T_world_first) @ T_world_last, abs(to_m - from_m)
