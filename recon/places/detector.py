"""Detection of loops during a drive."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Final, Protocol, runtime_checkable

import numpy as np

from recon.core.geometry.se3 import angle_rad, invert
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float64
from recon.places.agree import LOOP_SIGMAS, agreeing_loops
from recon.places.drift import drift_over, is_possible
from recon.places.keyframe import Keyframe, make_keyframe, words_of
from recon.places.loop import Loop
from recon.places.places import Place, Places, most_alike
from recon.places.verify import verify

CONTRADICTED: Final = "odometry contradicts"
"""Why a loop is refused that differs from odometry by more than its drift explains."""


_DISTANCE_M: Final = 1.5
"""Distance from the last keyframe at which a new one is taken."""

_ANGLE_DEG: Final = 10.0
"""Rotation since the last keyframe at which a new one is taken."""

_MIN_LIKENESS: Final = 0.3
"""Least likeness of a candidate, as a share of that of two neighbouring keyframes."""


@dataclass(frozen=True, eq=False)
class StoredKeyframe:
    """A keyframe with its pose and the result of its search for loops.

    Attributes:
        keyframe: Features and coarse disparities.
        T_world_camera: float64 (4, 4), by odometry.
        path_m: Path up to it, by `path_lengths`.
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
        """Return the number of keyframes."""
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

        Args:
            frame: Its number.
            pair: Its images.
            disparity: Of its left view.
            T_world_camera: float64 (4, 4), by odometry.
            path_m: Path up to it, by `path_lengths`.
            trusted: False where the pose is extrapolated; such a frame is no keyframe, nor is one
                that was not matched.
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
        """Return the keyframe with the loop to the first candidate that is verified, if any is."""
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
        """Return numbers of old keyframes that may be near, most similar first."""
        near = self._places.near(place)
        if not near.any():
            return []
        likeness = self._places.likeness(place)
        worth = np.flatnonzero(near & (likeness >= _MIN_LIKENESS * likeness[-1]))
        return most_alike(likeness, worth, self._places.path_m[:, None])

    def _possible(self, old: int, new: Place, loop: Loop) -> bool:
        """Return whether drift explains the difference between a loop and odometry."""
        T = invert(self._places.T_world_camera[old]) @ new.T_world_camera
        drift = drift_over(new.path_m - float(self._places.path_m[old]))
        return is_possible(invert(T) @ loop.T_first_last, drift, LOOP_SIGMAS)
