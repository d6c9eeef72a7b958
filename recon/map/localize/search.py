"""The first fix: places recognised in several frames that agree."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.places.detector import KnownPlaces
from recon.places.keyframe import Keyframe
from recon.places.loop import Loop, agreeing_loops

_REMEMBERED: Final = 10
"""Frames whose recognised places still count."""

_NEIGHBOURS: Final = 3
"""Views around a recognised place that must show it, too."""


@dataclass(frozen=True, eq=False)
class _Sight:
    """A frame, and the views of the map that show the same place.

    Attributes:
        T_odometry_camera: float64 (4, 4).
        path_m: Path up to it.
        loops: From the views to it.
    """

    T_odometry_camera: Float64
    path_m: float
    loops: list[Loop]


class Search:
    """Looks for a drive in a map until enough views of it agree.

    Where two places look alike both are found, contradict each other, and neither is believed.

    Args:
        known: The places of the map.
        frames: Least number of frames that must agree.
    """

    def __init__(self, known: KnownPlaces, frames: int) -> None:
        self._known = known
        self._frames = frames
        self._seen: deque[_Sight] = deque(maxlen=_REMEMBERED)

    def add(
        self,
        keyframe: Keyframe,
        camera: RectifiedCamera,
        T_odometry_camera: Float64,
        path_m: float,
        among: Bool | None = None,
    ) -> list[Loop]:
        """Add the next frame; return its loops that are believed, perhaps none.

        Args:
            keyframe: The frame.
            camera: That took it.
            T_odometry_camera: float64 (4, 4), its pose by odometry.
            path_m: Path up to it.
            among: bool (N,), the views that may be compared; None = all.
        """
        loops = self._loops(keyframe, camera, among)
        self._seen.append(_Sight(T_odometry_camera, path_m, loops))
        return [loop for loop in self._agreeing() if loop.last == keyframe.frame]

    def forget(self) -> None:
        """Begin again."""
        self._seen.clear()

    def _loops(self, keyframe: Keyframe, camera: RectifiedCamera, among: Bool | None) -> list[Loop]:
        """Return loops from recognised views and from those around them, each view once."""
        found = {loop.first: loop for loop in self._known.recognise(keyframe, camera, among).loops}
        for loop in list(found.values()):
            T = self._known.T_world_camera[loop.first] @ loop.T_first_last
            for number in self._known.near(T, _NEIGHBOURS):
                other = None if number in found else self._known.compare(number, keyframe, camera)
                if other is not None and other.loop is not None:
                    found[number] = other.loop
        return list(found.values())

    def _agreeing(self) -> list[Loop]:
        loops = [loop for sight in self._seen for loop in sight.loops]
        if not loops:
            return []
        # The map is a rigid thing: only the drive in it drifts.
        firsts = {loop.first: (self._known.T_world_camera[loop.first], 0.0) for loop in loops}
        lasts = {
            loop.last: (sight.T_odometry_camera, sight.path_m)
            for sight in self._seen
            for loop in sight.loops
        }
        return agreeing_loops(loops, firsts, lasts, keyframes=self._frames)
