"""A rendered room as a source: a rig like that of EuRoC, carried at one height or flown."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from recon.core.geometry.se3 import make_transform
from recon.core.values.arrays import Float64
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from recon.street.shapes import Material, Paint, boxes, merge
from recon.street.street import StreetWorld, rig

ROOM_M = (9.0, 8.0, 3.2)
TABLE_M = ((3.6, 3.4, 0.0), (4.6, 4.4, 0.75))
RADIUS_M = 2.2


class RoomSource(SyntheticSource):
    """A walk around the table, looking along the path.

    Args:
        heights_m: Height of the camera above the floor, one per frame.
    """

    def __init__(self, heights_m: Float64) -> None:
        rig_like_euroc = {"width_px": 376, "height_px": 240, "focal_px": 229.0, "baseline_m": 0.11}
        super().__init__(StreetScene(frames=len(heights_m), **rig_like_euroc))
        self.heights_m = heights_m

    @cached_property
    def world(self) -> StreetWorld:
        """The room and the path through it."""
        return StreetWorld(
            self.settings, _room(), rig(self.settings), self._poses(), np.array([0.0, 0.0, 1.0])
        )

    def _poses(self) -> Float64:
        """float64 (N, 4, 4), counter-clockwise, three quarters of a circle."""
        poses = []
        middle = np.mean(TABLE_M, axis=0)
        for angle, height in zip(
            np.linspace(-np.pi / 2, np.pi, len(self.heights_m)), self.heights_m, strict=True
        ):
            forward = np.array([-np.sin(angle), np.cos(angle), 0.0])
            right = np.array([np.cos(angle), np.sin(angle), 0.0])
            place = middle[:2] + RADIUS_M * right[:2]
            rotation = np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)
            poses.append(make_transform(rotation, np.array([*place, height])))
        return np.stack(poses)


def _room():
    """Floor, four walls and a table, in coarse textures."""
    x, y, z = ROOM_M
    sides = [
        ((0, 0, -0.1), (x, y, 0), Material.ASPHALT),
        ((-0.1, 0, 0), (0, y, z), Material.POSTER),
        ((x, 0, 0), (x + 0.1, y, z), Material.BRICK),
        ((0, -0.1, 0), (x, 0, z), Material.POSTER),
        ((0, y, 0), (x, y + 0.1, z), Material.BRICK),
        (*TABLE_M, Material.POSTER),
    ]
    return merge(
        boxes(low, high, Paint(material, (0.6, 0.5, 0.4), part))
        for part, (low, high, material) in enumerate(sides)
    )
