"""Looks for loops while a drive goes on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from recon.geometry.se3 import angle_rad, invert
from recon.loops.drift import Drift, drift_over, is_possible
from recon.loops.keyframe import Keyframe, make_keyframe, words_of
from recon.loops.settings import LoopSettings
from recon.loops.verify import Loop, verify
from recon.structures import Disparity, RectifiedPair
from recon.structures.arrays import Float64

ALIKE = Drift(0.3, np.deg2rad(1.0))
"""Standard deviation of a verified loop that drift is compared with: small, and never nothing."""


@dataclass(frozen=True, eq=False)
class StoredKeyframe:
    """A keyframe, where odometry saw it, and what was found there.

    Attributes:
        keyframe: Features and shape.
        T_world_camera: float64 (4, 4), by odometry.
        path_m: Path up to it, as `doubtful_path` counts it.
        loops: Verified loops that end in it.
        refused: Why other candidates were refused.
    """

    keyframe: Keyframe
    T_world_camera: Float64
    path_m: float
    loops: tuple[Loop, ...] = ()
    refused: tuple[str, ...] = ()


@runtime_checkable
class KeyframeStore(Protocol):
    """Keeps keyframes out of the detector's memory."""

    def put(self, stored: StoredKeyframe) -> None:
        """Keep a keyframe."""
        ...

    def get(self, frame: int) -> StoredKeyframe:
        """The keyframe of a frame, as it was put."""
        ...


class KeyframeMemory:
    """Keeps keyframes in memory: for short drives."""

    def __init__(self) -> None:
        self._kept: dict[int, StoredKeyframe] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[StoredKeyframe]:
        return iter(self._kept.values())

    def put(self, stored: StoredKeyframe) -> None:
        """Keep a keyframe."""
        self._kept[stored.keyframe.frame] = stored

    def get(self, frame: int) -> StoredKeyframe:
        """The keyframe of a frame."""
        return self._kept[frame]


@dataclass(frozen=True, eq=False)
class _Place:
    """What stays in memory of a keyframe."""

    frame: int
    T_world_camera: Float64
    path_m: float
    words: NDArray[np.uint32]


class LoopDetector:
    """Looks for earlier places in each keyframe of a drive.

    All it remembers of a keyframe is its pose and some kilobytes of words; the rest goes to the
    store. The same frames in the same order give the same loops.

    Args:
        settings: What is kept, compared and believed.
        store: Where keyframes go.
    """

    def __init__(self, settings: LoopSettings, store: KeyframeStore) -> None:
        self._settings = settings
        self._store = store
        self._places: list[_Place] = []
        self.loops: list[Loop] = []
        self.refused: Counter[str] = Counter()

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self._places)

    def add(
        self,
        frame: int,
        pair: RectifiedPair,
        disparity: Disparity,
        T_world_camera: Float64,
        *,
        path_m: float,
        measured: bool = True,
    ) -> tuple[Loop, ...]:
        """Take the next frame; loops that geometry confirms are given, and kept in ``loops``.

        Args:
            frame: Its number.
            pair: Its pictures.
            disparity: Of its left view.
            T_world_camera: float64 (4, 4), by odometry.
            path_m: Path up to it, as `doubtful_path` counts it.
            measured: False where the pose rests on no measurement; such a frame is no keyframe.
        """
        if not measured or not self._is_due(T_world_camera):
            return ()
        keyframe = make_keyframe(frame, pair, disparity, self._settings.keyframes)
        stored = self._compared(StoredKeyframe(keyframe, T_world_camera, path_m), pair)
        self._store.put(stored)
        self.restore(stored)
        return stored.loops

    def restore(self, stored: StoredKeyframe) -> None:
        """Take a keyframe of an interrupted drive, with what was found there."""
        self._places.append(self._place(stored))
        self.loops.extend(stored.loops)
        self.refused.update(stored.refused)

    def agreeing(self) -> list[Loop]:
        """The loops that enough others of other keyframes confirm."""
        poses = {place.frame: (place.T_world_camera, place.path_m) for place in self._places}
        return agreeing_loops(self.loops, poses, self._settings)

    def _place(self, stored: StoredKeyframe) -> _Place:
        words = words_of(stored.keyframe.descriptors, self._settings.candidates)
        return _Place(stored.keyframe.frame, stored.T_world_camera, stored.path_m, words)

    def _is_due(self, T_world_camera: Float64) -> bool:
        if not self._places:
            return True
        T = invert(self._places[-1].T_world_camera) @ T_world_camera
        settings = self._settings.keyframes
        moved = float(np.linalg.norm(T[:3, 3])) >= settings.distance_m
        return moved or float(np.rad2deg(angle_rad(T))) >= settings.angle_deg

    def _compared(self, new: StoredKeyframe, pair: RectifiedPair) -> StoredKeyframe:
        """The keyframe with the first candidate that is one place with it, if any is."""
        place, refused = self._place(new), []
        for old in self._candidates(place):
            known = self._store.get(old.frame).keyframe
            verdict = verify(known, new.keyframe, pair.camera, self._settings.verify)
            if verdict.loop is None:
                refused.append(verdict.refused)
            elif self._possible(old, place, verdict.loop):
                return replace(new, loops=(verdict.loop,), refused=tuple(refused))
            else:
                refused.append("odometry contradicts")
        return replace(new, refused=tuple(refused))

    def _candidates(self, place: _Place) -> list[_Place]:
        """Old keyframes that may be near, most alike first."""
        near = [old for old in self._places if self._may_be_near(old, place)]
        if not near:
            return []
        expected = likeness(place.words, self._places[-1].words)
        least = self._settings.candidates.min_likeness * expected
        ranked = sorted((-likeness(place.words, old.words), old.frame, old) for old in near)
        chosen: list[_Place] = []
        for negative, _, old in ranked:
            if -negative < least or len(chosen) == self._settings.candidates.verified:
                break
            gaps = (abs(old.path_m - other.path_m) for other in chosen)
            if min(gaps, default=np.inf) >= self._settings.candidates.apart_m:
                chosen.append(old)
        return chosen

    def _may_be_near(self, old: _Place, new: _Place) -> bool:
        """Whether odometry could be so wrong that the two look at the same."""
        settings = self._settings.candidates
        path_m = new.path_m - old.path_m
        if path_m < settings.min_path_m:
            return False
        drift = drift_over(path_m, self._settings.drift)
        sigmas = self._settings.drift.sigmas
        T = invert(old.T_world_camera) @ new.T_world_camera
        far_m = float(np.linalg.norm(T[:3, 3])) - sigmas * drift.position_m
        turned = float(angle_rad(T)) - sigmas * drift.angle_rad
        return far_m <= settings.view_m and turned <= np.deg2rad(settings.view_deg)

    def _possible(self, old: _Place, new: _Place, loop: Loop) -> bool:
        T = invert(old.T_world_camera) @ new.T_world_camera
        drift = drift_over(new.path_m - old.path_m, self._settings.drift)
        return is_possible(invert(T) @ loop.T_first_last, drift, ALIKE, self._settings.drift)


def likeness(words: NDArray[np.uint32], others: NDArray[np.uint32]) -> float:
    """Share of words that two pictures have in common, in [0, 1]."""
    if not len(words) or not len(others):
        return 0.0
    shared = np.intersect1d(words, others, assume_unique=True).size
    return float(shared / np.sqrt(len(words) * len(others)))


def agreeing_loops(
    loops: list[Loop], poses: dict[int, tuple[Float64, float]], settings: LoopSettings
) -> list[Loop]:
    """The loops that enough others of other keyframes confirm.

    Two neighbouring loops and the odometry between their ends make a ring that must close
    within the drift over its two short ways; a false match would have to be wrong in the same
    way time after time.

    Args:
        loops: Verified loops.
        poses: For each keyframe of a loop its pose by odometry, and the path up to it.
        settings: How near neighbours are, and how many must agree.
    """
    paths_m = np.array([(poses[loop.first][1], poses[loop.last][1]) for loop in loops])
    agreeing = []
    for number, loop in enumerate(loops):
        apart_m = np.abs(paths_m - paths_m[number]).max(axis=1)
        others = [loops[k] for k in np.flatnonzero(apart_m <= settings.agree_m)]
        same = {other.last for other in others if _agree(loop, other, poses, settings)}
        if len(same) >= settings.min_agreeing:
            agreeing.append(loop)
    return agreeing


def _agree(
    one: Loop, other: Loop, poses: dict[int, tuple[Float64, float]], settings: LoopSettings
) -> bool:
    """Whether two neighbouring loops tell the same."""
    T_lasts, lasts_m = _between(one.last, other.last, poses)
    T_firsts, firsts_m = _between(one.first, other.first, poses)
    ring = invert(one.T_first_last) @ T_firsts @ other.T_first_last @ invert(T_lasts)
    drift = drift_over(lasts_m + firsts_m, settings.drift)
    return is_possible(ring, drift, ALIKE, settings.drift)


def _between(
    first: int, last: int, poses: dict[int, tuple[Float64, float]]
) -> tuple[Float64, float]:
    """``T_first_last`` by odometry, and the path between the two."""
    (T_world_first, from_m), (T_world_last, to_m) = poses[first], poses[last]
    return invert(T_world_first) @ T_world_last, abs(to_m - from_m)
