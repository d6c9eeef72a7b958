"""Detection of loops during a drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol, runtime_checkable

import numpy as np

from recon.core.geometry.se3 import angle_rad, invert
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Bool, Float64, freeze
from recon.places.keyframe import Keyframe, make_keyframe, words_of
from recon.places.loop import LOOP_SIGMAS, Loop, agreeing_loops
from recon.places.places import (
    VIEW_DEG,
    VIEW_M,
    Place,
    Places,
    WordIndex,
    drift_over,
    is_possible,
    most_alike,
)
from recon.places.verify import Verdict, verify

CONTRADICTED: Final = "odometry contradicts"
"""Why a loop is refused that differs from odometry by more than its drift explains."""
_DISTANCE_M: Final = 1.5  # distance from the last keyframe at which a new one is taken
_ANGLE_DEG: Final = 10.0  # rotation since the last keyframe at which a new one is taken
_MIN_LIKENESS: Final = 0.3
"""Least likeness of a candidate, as a share of that of two neighbouring keyframes."""


@dataclass(frozen=True, eq=False)
class StoredKeyframe:
    """A keyframe with its pose and the result of its search for loops."""

    keyframe: Keyframe  # features and coarse disparities
    T_world_camera: Float64  # (4, 4), by odometry
    path_m: float  # path up to it, by `path_lengths`
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


class LoopDetector:
    """Searches the earlier keyframes of a drive for the place of each new one.

    It keeps the pose and some kilobytes of words of each keyframe; the rest goes to the store. The
    same frames in the same order give the same loops.

    Args:
        store: Where keyframes go.
        search: Whether to look for loops; else keyframes are only kept, for later drives.
    """

    def __init__(self, store: KeyframeStore, *, search: bool = True) -> None:
        self._store = store
        self._search = search
        self._places = Places()
        self.loops: list[Loop] = []
        self.refused: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._places)

    def add(
        self,
        frame: int,
        pair: RectifiedPair,
        disparity: Disparity,
        T_world_camera: Float64,
        *,
        path_m: float,
        trusted: bool = True,
    ) -> tuple[Loop, ...]:
        """Add the next frame; return its verified loops, which ``loops`` keeps as well.

        A frame with a pose that is not trusted is no keyframe, nor is one that was not matched.
        ``path_m`` is the path up to it, by `path_lengths`.
        """
        if not trusted or not disparity.valid.any() or not self._is_due(T_world_camera):
            return ()
        keyframe = make_keyframe(frame, pair, disparity)
        return self.look(StoredKeyframe(keyframe, T_world_camera, path_m), pair.camera)

    def look(self, new: StoredKeyframe, camera: RectifiedCamera) -> tuple[Loop, ...]:
        """Add the next keyframe; return its verified loops."""
        stored = self._compared(new, camera) if self._search else new
        self._store.put(stored)
        self.restore(stored)
        return stored.loops

    def restore(self, stored: StoredKeyframe) -> None:
        """Add a keyframe of an interrupted drive, with its loops."""
        self._places.add(self._place(stored))
        self.loops.extend(stored.loops)
        self.refused.update(stored.refused)

    def agreeing(self) -> list[Loop]:
        """Return the loops that enough loops of other keyframes confirm."""
        places = self._places
        known = zip(places.frames, places.T_world_camera, places.path_m.tolist(), strict=True)
        poses = {frame: (T, path_m) for frame, T, path_m in known}
        return agreeing_loops(self.loops, poses, poses)

    def _place(self, stored: StoredKeyframe) -> Place:
        words = words_of(stored.keyframe.descriptors)
        return Place(stored.keyframe.frame, stored.T_world_camera, stored.path_m, words)

    def _is_due(self, T_world_camera: Float64) -> bool:
        if not len(self._places):
            return True
        T = invert(self._places.T_world_camera[-1]) @ T_world_camera
        moved = float(np.linalg.norm(T[:3, 3])) >= _DISTANCE_M
        return moved or float(np.rad2deg(angle_rad(T))) >= _ANGLE_DEG

    def _compared(self, new: StoredKeyframe, camera: RectifiedCamera) -> StoredKeyframe:
        """The keyframe with the loop to the first candidate that is verified, if any is."""
        place, refused = self._place(new), []
        for old in self._candidates(place):
            known = self._store.get(self._places.frames[old]).keyframe
            verdict = verify(known, new.keyframe, camera)
            if verdict.loop is None:
                refused.append(verdict.refused)
            elif self._possible(old, place, verdict.loop):
                return replace(new, loops=(verdict.loop,), refused=tuple(refused))
            else:
                refused.append(CONTRADICTED)
        return replace(new, refused=tuple(refused))

    def _candidates(self, place: Place) -> list[int]:
        """Numbers of old keyframes that may be near, most similar first."""
        near = self._places.near(place)
        if not near.any():
            return []
        likeness = self._places.likeness(place)
        worth = np.flatnonzero(near & (likeness >= _MIN_LIKENESS * likeness[-1]))
        return most_alike(likeness, worth, self._places.path_m[:, None])

    def _possible(self, old: int, new: Place, loop: Loop) -> bool:
        """Whether drift explains the difference between a loop and odometry."""
        T = invert(self._places.T_world_camera[old]) @ new.T_world_camera
        drift = drift_over(new.path_m - float(self._places.path_m[old]))
        return is_possible(invert(T) @ loop.T_first_last, drift, LOOP_SIGMAS)


_TURN_M: Final = 4.0  # two views in opposite directions count as twice this far apart


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
        focal_px: Focal length of most of them; None = there are none.
    """

    def __init__(self, views: Sequence[KnownView]) -> None:
        self._views = views
        self._words = WordIndex()
        poses, focals_px = [], []
        for view in views:
            self._words.add(words_of(view.keyframe.descriptors))
            poses.append(view.T_world_camera)
            focals_px.append(view.camera.focal_px)
        self.focal_px = float(np.median(focals_px)) if focals_px else None
        self.T_world_camera: Float64 = np.array(poses).reshape(-1, 4, 4)
        ahead = self.T_world_camera[:, :3, 2]
        self._stands = np.hstack([self.T_world_camera[:, :3, 3], _TURN_M * ahead])

    def __len__(self) -> int:
        return len(self._views)

    def recognise(
        self, keyframe: Keyframe, camera: RectifiedCamera, among: Bool | None = None
    ) -> Recognised:
        """The views, of those given, that show the same place as a frame, and their loops.

        One such view alone proves little: `agreeing_loops` says which of several frames agree.
        """
        likeness = self._words.likeness(words_of(keyframe.descriptors))
        worth = likeness > 0 if among is None else among & (likeness > 0)
        found = most_alike(likeness, np.flatnonzero(worth), self._stands)
        verdicts = [self.compare(number, keyframe, camera) for number in found]
        return Recognised(
            tuple(verdict.loop for verdict in verdicts if verdict.loop is not None),
            tuple(verdict.refused for verdict in verdicts if verdict.loop is None),
        )

    def near(self, T_world_camera: Float64, most: int) -> list[int]:
        """Return numbers of the views that a camera may share a view with, nearest first."""
        T = invert(self.T_world_camera) @ T_world_camera
        far_m = np.linalg.norm(T[:, :3, 3], axis=1)
        near = np.flatnonzero((far_m <= VIEW_M) & (angle_rad(T) <= np.deg2rad(VIEW_DEG)))
        ordered: list[int] = near[np.argsort(far_m[near], kind="stable")][:most].tolist()
        return ordered

    def compare(self, number: int, keyframe: Keyframe, camera: RectifiedCamera) -> Verdict:
        """Return whether a view shows the same place as a frame; ``first`` is its number."""
        view = self._views[number]
        verdict = verify(view.keyframe, keyframe, camera, view.camera)
        if verdict.loop is None:
            return verdict
        return Verdict(replace(verdict.loop, first=number))
