"""The places of a map, to recognise one of them in another drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import angle_rad, invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64, freeze
from recon.places.keyframe import Keyframe, words_of
from recon.places.loop import Loop
from recon.places.places import VIEW_DEG, VIEW_M, WordIndex, most_alike
from recon.places.verify import Verdict, verify

_TURN_M: Final = 4.0
"""Two views in opposite directions count as twice this far apart."""


@dataclass(frozen=True, eq=False)
class KnownView:
    """A keyframe of a map.

    Attributes:
        keyframe: What it shows.
        camera: The rectified camera that took it.
        T_world_camera: float64 (4, 4), in the world of the map.
        session: Number of its drive.
    """

    keyframe: Keyframe
    camera: RectifiedCamera
    T_world_camera: Float64
    session: int = 0

    def __post_init__(self) -> None:
        freeze(self, "T_world_camera", np.float64, (4, 4))


@dataclass(frozen=True)
class Recognised:
    """What a search for a place gives.

    Attributes:
        loops: One for each place that is verified, most similar first; several are alike. ``first``
            is the number of the view, ``last`` the frame that was looked for.
        refused: Why other candidates were refused.
    """

    loops: tuple[Loop, ...]
    refused: tuple[str, ...]


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
        """Return the number of views."""
        return len(self._views)

    def recognise(
        self, keyframe: Keyframe, camera: RectifiedCamera, among: Bool | None = None
    ) -> Recognised:
        """Return the views that show the same place as a frame, and where it is seen from there.

        One such view alone proves little: `agreeing_loops` says which of several frames agree.

        Args:
            keyframe: The frame.
            camera: That took it.
            among: bool (N,), the views that may be compared; None = all.
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
