"""The space that the vehicle took up on its way: it was free while the vehicle was there.

A camera that looks ahead never sees the ground on which it starts, and what passed in front of it
may have left hits. But where a vehicle drives there is nothing else, from the ground to the height
of its camera and as wide as it is. That counts more than what was seen before, and less than what
is seen on a later visit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Bool, Float64, Int32, Int64, freeze
from recon.map.ground.surface import GroundSurface

_SAME_M: Final = 0.3
"""Heights of the camera above the ground that differ by less are those of one vehicle."""
_STEADY: Final = 0.8
"""Fraction of the path on which the height is the same, if something carries the camera."""


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """The path of the camera in small steps, where its poses are trusted; map axes.

    ``points_m`` is float64 (P, 3), ``submap`` int64 (P,) the number of the submap of each point.
    """

    points_m: Float64
    submap: Int64

    def __post_init__(self) -> None:
        freeze(self, "points_m", np.float64, (None, 3))
        freeze(self, "submap", np.int64, (len(self.points_m),))

    @classmethod
    def through(cls, path_m: Float64, trusted: Bool, submap: Int64, step_m: float) -> DrivenPath:
        """Fill in the path (N, 3) between neighbouring poses that are both trusted."""
        length_m = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
        joined = trusted[:-1] & trusted[1:]
        steps = np.where(joined, np.ceil(length_m / step_m), 1).astype(np.int64).clip(min=1)
        end = np.repeat(np.arange(1, len(path_m)), steps)
        left = np.repeat(np.cumsum(steps), steps) - np.arange(1, steps.sum() + 1)
        ratio = (left / np.repeat(steps, steps))[:, None]
        between = ratio * path_m[end - 1] + (1 - ratio) * path_m[end]
        keep = np.append(trusted[0], trusted[end])
        points = np.concatenate([path_m[:1], between])
        return cls(points[keep], np.append(submap[0], submap[end])[keep])

    def select(self, which: NDArray[Any]) -> DrivenPath:
        return DrivenPath(self.points_m[which], self.submap[which])


def is_driven(drops_m: Float64, camera_height_m: float) -> bool:
    """Return whether something carries the camera over the ground; a drone does not.

    ``drops_m`` (C,) are heights of the path above what was seen below it, place by place; a
    ``camera_height_m`` of NaN is unknown.
    """
    if not np.isfinite(camera_height_m):
        return False
    steady = np.abs(drops_m - camera_height_m) <= _SAME_M
    return bool(len(drops_m) == 0 or steady.mean() >= _STEADY)


def sweep(points_m: Float64, ground: GroundSurface, width_m: float, resolution_m: float) -> Int32:
    """Return the voxels that a vehicle took up, int32 (N, 3), each once.

    They are the columns that the path crosses and those with their centre within half a ``width_m``
    of it, from the ground up to the camera; none where something else than the ground was seen
    below it. ``points_m`` is its path, (P, 3), in steps of at most half a voxel; map axes.
    """
    off_m = np.abs(ground.drop_at(points_m[:, :2]) - ground.camera_height_m)
    on_ground = ~(off_m > _SAME_M)  # not above something else; ground that was not seen is ground
    columns, top_m = _columns(points_m[on_ground], width_m, resolution_m)
    floor_m = ground.height_at((columns + 0.5) * resolution_m)
    known = np.isfinite(floor_m)
    columns, floor_m, top_m = columns[known], floor_m[known], top_m[known]
    first = np.ceil(floor_m / resolution_m - 0.5).astype(np.int64)
    last = np.maximum(first, np.floor(top_m / resolution_m - 0.5).astype(np.int64))
    number = last - first + 1
    above = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    keys = np.column_stack([np.repeat(columns, number, axis=0), np.repeat(first, number) + above])
    return keys.astype(np.int32)


def _columns(points_m: Float64, width_m: float, resolution_m: float) -> tuple[Int64, Float64]:
    """Return columns (N, 2) near the path, each once, and its lowest height near each, (N,)."""
    reach = int(np.ceil(width_m / 2 / resolution_m)) + 1
    around = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    home = np.floor(points_m[:, :2] / resolution_m).astype(np.int64)
    columns = home[:, None] + around
    offset = (columns + 0.5) * resolution_m - points_m[:, None, :2]
    near = (np.linalg.norm(offset, axis=2) <= width_m / 2) | (around == 0).all(axis=1)
    found, place = np.unique(columns[near], axis=0, return_inverse=True)
    top_m = np.full(len(found), np.inf)
    np.minimum.at(top_m, place.ravel(), points_m[np.nonzero(near)[0], 2])
    return found, top_m
