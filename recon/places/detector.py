"""Detection of loops during a drive."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final, Protocol, runtime_checkable

import numpy as np

from recon.core.geometry.se3 import angle_rad, apply, invert
from recon.core.values import Disparity, Rectified, RectifiedCamera
from recon.core.values.arrays import Bool, Float32, Float64, freeze
from recon.core.values.camera import project
from recon.places.keyframe import Keyframe, coarse_of, coarse_points, make_keyframe, words_of
from recon.places.places import (
    VIEW_DEG,
    Loop,
    Place,
    Places,
    WordIndex,
    agreeing_loops,
    drift_over,
    is_possible,
    loop_sigmas,
    most_alike,
    reach_of,
)
from recon.places.verify import Verdict, verify

CONTRADICTED: Final = "odometry contradicts"
"""Why a loop is refused that differs from odometry by more than its drift explains."""
_SEEN_RATIO: Final = 0.75
"""Fraction of what either of a view and the last keyframe shows, and the other can see, from which
on the view is no new one."""

_HERE: Final = (3, 3)
"""Loops of a keyframe that are enough, and how many more candidates may fail, where it is compared
with places that odometry says it may be near."""

_ANYWHERE: Final = (10, 8)  # the same where odometry says nothing: another segment of the drive
_MIN_LIKENESS: Final = 0.3
"""Least likeness of a candidate, as a fraction of that of two neighbouring keyframes."""


@dataclass(frozen=True, eq=False)
class StoredKeyframe:
    """A keyframe with its pose and the result of its search for loops."""

    keyframe: Keyframe  # features and coarse disparities
    T_world_camera: Float64  # (4, 4), by odometry
    path_m: float  # path up to it, by `path_lengths`
    segment: int = 0  # of the drive that it belongs to: nothing is known between segments
    loops: tuple[Loop, ...] = ()  # verified loops that end in it
    refused: tuple[str, ...] = ()  # why other candidates were refused


@runtime_checkable
class KeyframeStore(Protocol):
    """Where the detector keeps keyframes, in memory or on disk."""

    def put(self, stored: StoredKeyframe) -> None:
        """Keep a keyframe."""
        ...

    def get(self, frame: int) -> StoredKeyframe:
        """Return the keyframe of a frame, as it was put."""
        ...


@dataclass(frozen=True, eq=False)
class LastView:
    """The last view that showed something new."""

    coarse: Float32  # (h, w), `coarse_of` its disparity
    T_world_camera: Float64  # (4, 4)
    segment: int = 0  # of the drive


class NewViews:
    """Tells which views show enough that the last of them did not, or too little of what it did.

    ``last`` is set by who takes a view for new; None = there was none.
    """

    def __init__(self, camera: RectifiedCamera) -> None:
        self._camera = camera
        self.last: LastView | None = None

    def is_new(self, disparity: Disparity, T_world_camera: Float64, segment: int = 0) -> bool:
        last = self.last
        if last is None or last.segment != segment:
            return True
        T_last_new = invert(last.T_world_camera) @ T_world_camera
        ratios = (
            self._share_in_view(coarse_of(disparity), T_last_new),
            self._share_in_view(last.coarse, invert(T_last_new)),
        )
        return min(ratios) < _SEEN_RATIO

    def _share_in_view(self, coarse: Float32, T: Float64) -> float:
        """Return the fraction of what one view shows that another one can see."""
        camera = self._camera
        u, v, _ = project(apply(T, coarse_points(coarse, camera)), camera)
        with np.errstate(invalid="ignore"):
            inside = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
        return float(inside.mean()) if inside.size else 0.0


class LoopDetector:
    """Searches the earlier keyframes of a drive for the place of each new one.

    It keeps the pose and some kilobytes of words of each keyframe; the rest goes to the store. The
    same frames in the same order give the same loops.

    Args:
        store: Where keyframes go.
        camera: The rectified camera of the drive.
        search: Whether to look for loops; else keyframes are only kept, for later drives.
        scale: Of the scene, against a road.
    """

    def __init__(
        self,
        store: KeyframeStore,
        camera: RectifiedCamera,
        *,
        search: bool = True,
        scale: float = 1.0,
    ) -> None:
        self._store, self._camera = store, camera
        self._search, self._scale = search, scale
        self._places = Places(scale)
        self._views = NewViews(camera)
        self.loops: list[Loop] = []
        self.refused: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._places)

    def add(
        self,
        frame: int,
        pair: Rectified,
        disparity: Disparity,
        T_world_camera: Float64,
        *,
        path_m: float,
        segment: int = 0,
    ) -> tuple[Loop, ...]:
        """Add the next frame; return its verified loops, which ``loops`` keeps as well.

        A frame is a keyframe if it sees enough that the last one did not, or too little of what
        that did, or another segment of the drive begins; not one that was not matched, or with a
        pose that is not trusted, of segment -1. ``path_m`` is the path up to it, by `path_lengths`.
        """
        seen = segment >= 0 and bool(disparity.measured.any())
        if not seen or not self._views.is_new(disparity, T_world_camera, segment):
            return ()
        keyframe = make_keyframe(frame, pair, disparity)
        return self.look(StoredKeyframe(keyframe, T_world_camera, path_m, segment))

    def look(self, new: StoredKeyframe) -> tuple[Loop, ...]:
        """Add the next keyframe; return its verified loops."""
        stored = new
        if self._search:
            place, elsewhere = self._place(new), self._places.segments != new.segment
            among = self._places.near(place) & ~elsewhere
            here = self._loops_among(among, new, place, *_HERE)
            there = self._loops_among(elsewhere, new, place, *_ANYWHERE)
            stored = replace(new, loops=(*here[0], *there[0]), refused=(*here[1], *there[1]))
        self._store.put(stored)
        self.restore(stored)
        return stored.loops

    def restore(self, stored: StoredKeyframe) -> None:
        """Add a keyframe of an interrupted drive, with its loops."""
        self._places.add(self._place(stored))
        self._views.last = LastView(stored.keyframe.coarse, stored.T_world_camera, stored.segment)
        self.loops.extend(stored.loops)
        self.refused.update(stored.refused)

    def agreeing(self) -> list[Loop]:
        """Return the loops that enough others confirm, and those between two segments.

        How these confirm one another is not known before all segments are placed.
        """
        places = self._places
        known = zip(
            places.T_world_camera, places.path_m.tolist(), places.segments.tolist(), strict=True
        )
        poses = dict(zip(places.frames, known, strict=True))
        apart = {id(one) for one in self.loops if poses[one.first][2] != poses[one.last][2]}
        own = [one for one in self.loops if id(one) not in apart]
        agreeing = agreeing_loops(own, poses, poses, scale=self._scale)
        return [*agreeing, *(one for one in self.loops if id(one) in apart)]

    def _place(self, stored: StoredKeyframe) -> Place:
        keyframe, reach_m = stored.keyframe, reach_of(stored.keyframe.depth_m(self._camera))
        words = words_of(keyframe.descriptors)
        pose = stored.T_world_camera
        return Place(keyframe.frame, pose, stored.path_m, stored.segment, reach_m, words)

    def _loops_among(
        self, among: Bool, new: StoredKeyframe, place: Place, enough: int, failures: int
    ) -> tuple[list[Loop], list[str]]:
        """The loops to some places, and why others were refused.

        The most similar ones are compared first, and after one that is verified those around it.
        """
        loops, refused = list[Loop](), list[str]()
        waiting = deque(islice(self._candidates(place, among), enough + failures))
        left = among.copy()
        while waiting and len(loops) < enough and len(refused) < failures + len(loops):
            old = waiting.popleft()
            if not left[old]:
                continue
            left[old] = False
            known = self._store.get(self._places.frames[old]).keyframe
            verdict = verify(known, new.keyframe, self._camera, scale=self._scale)
            if verdict.loop is None:
                refused.append(verdict.refused)
            elif not self._possible(old, place, verdict.loop):
                refused.append(CONTRADICTED)
            else:
                loops.append(verdict.loop)
                around = self._places.around(old, verdict.loop.T_first_last, place.reach_m)
                waiting.extendleft(reversed(around))
        return loops, refused

    def _candidates(self, place: Place, among: Bool) -> Iterator[int]:
        """Yield numbers of some old keyframes, most similar first."""
        if not among.any():
            return iter(())
        likeness = self._places.likeness(place)
        worth = np.flatnonzero(among & (likeness >= _MIN_LIKENESS * likeness[-1]))
        return most_alike(likeness, worth, self._places.path_m[:, None], place.reach_m)

    def _possible(self, old: int, new: Place, loop: Loop) -> bool:
        """Whether drift explains the difference between a loop and odometry, if there was any."""
        if self._places.segments[old] != new.segment:
            return True
        T = invert(self._places.T_world_camera[old]) @ new.T_world_camera
        drift = drift_over(new.path_m - float(self._places.path_m[old]), self._scale)
        return is_possible(invert(T) @ loop.T_first_last, drift, loop_sigmas(self._scale))


@dataclass(frozen=True, eq=False)
class KnownView:
    """A keyframe of a map."""

    keyframe: Keyframe  # what it shows
    camera: RectifiedCamera  # the rectified camera that took it
    T_world_camera: Float64  # (4, 4), in the world of the map
    session: int = 0  # number of its drive

    def __post_init__(self) -> None:
        freeze(self, "T_world_camera", np.float64, (4, 4))


@dataclass(frozen=True)
class Recognised:
    """What a search for a place gives."""

    # One for each place that is verified, most similar first; several are alike. ``first`` is the
    # number of the view, ``last`` the frame that was looked for.
    loops: tuple[Loop, ...]
    refused: tuple[str, ...]  # why other candidates were refused


class KnownPlaces:
    """Recognises the places of a map; some kilobytes for each view are kept in memory.

    Args:
        views: The keyframes of the map, read once now, and again whenever one is compared.

    Attributes:
        T_world_camera: float64 (N, 4, 4), where the views were taken, in the world of the map.
        scale: That of the scene, against a road.
    """

    def __init__(self, views: Sequence[KnownView], scale: float = 1.0) -> None:
        self._views, self.scale = views, scale
        self._words = WordIndex()
        poses, reach_m = list[Float64](), list[float]()
        for view in views:
            self._words.add(words_of(view.keyframe.descriptors))
            poses.append(view.T_world_camera)
            reach_m.append(reach_of(view.keyframe.depth_m(view.camera)))
        self.T_world_camera: Float64 = np.array(poses).reshape(-1, 4, 4)
        self._reach_m = float(np.median(reach_m)) if reach_m else 0.0
        # Two views in opposite directions count as apart.
        ahead = self._reach_m * self.T_world_camera[:, :3, 2]
        self._stands = np.hstack([self.T_world_camera[:, :3, 3], 0.5 * ahead])

    def __len__(self) -> int:
        return len(self._views)

    def recognise(
        self,
        keyframe: Keyframe,
        camera: RectifiedCamera,
        among: Bool | None = None,
        *,
        most: int = 3,
    ) -> Recognised:
        """The views, of those given, that show the same place as a frame, and their loops.

        At most so many that look alike are compared. One such view alone proves little:
        `agreeing_loops` says which of several frames agree.
        """
        likeness = self._words.likeness(words_of(keyframe.descriptors))
        worth = likeness > 0 if among is None else among & (likeness > 0)
        alike = most_alike(likeness, np.flatnonzero(worth), self._stands, self._reach_m)
        found = islice(alike, most)
        verdicts = [self.compare(number, keyframe, camera) for number in found]
        return Recognised(
            tuple(verdict.loop for verdict in verdicts if verdict.loop is not None),
            tuple(verdict.refused for verdict in verdicts if verdict.loop is None),
        )

    def near(self, T_world_camera: Float64, most: int) -> list[int]:
        """Return numbers of the views that a camera may share a view with, nearest first."""
        T = invert(self.T_world_camera) @ T_world_camera
        far_m = np.linalg.norm(T[:, :3, 3], axis=1)
        near = np.flatnonzero((far_m <= self._reach_m) & (angle_rad(T) <= np.deg2rad(VIEW_DEG)))
        ordered: list[int] = near[np.argsort(far_m[near], kind="stable")][:most].tolist()
        return ordered

    def compare(self, number: int, keyframe: Keyframe, camera: RectifiedCamera) -> Verdict:
        """Return whether a view shows the same place as a frame; ``first`` is its number."""
        view = self._views[number]
        verdict = verify(view.keyframe, keyframe, camera, view.camera, self.scale)
        if verdict.loop is None:
            return verdict
        return Verdict(replace(verdict.loop, first=number))
