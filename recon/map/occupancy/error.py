"""What the error of depths explains: a surface that is seen again from nearer stands elsewhere.

A rig that is not as calibrated, or not rigid, and a path that drifts, move along its rays what a
frame saw. Later frames look through the place, as they do where something has moved; but the
surface is still there, beside that place along those rays. How far errors reach is measured, by
frames that saw the same from different places: so it is for every rig, matcher and path.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from recon.core.geometry.se3 import apply, invert
from recon.core.kernels.voxels import find_keys, pack_keys, unpack_keys
from recon.core.values import PointCloud
from recon.core.values.arrays import Bool, Float64, Int8, Int64
from recon.map.builders import OccupancySettings

_PAIRS: Final = 24  # of frames, from all over a map, that are compared
_NEAR: Final = 0.25  # largest distance of two compared frames, in ranges
_SAME_WAY: Final = 0.7  # least cosine between the views of two compared frames
_NORMAL: Final = 1.4826  # standard deviation of normal errors, in medians of their sizes


def frame_pairs(T_map_camera: Float64, range_m: float) -> Iterator[tuple[int, int]]:
    """Yield pairs of frames near each other that look the same way, as far apart in time as any."""
    places, ahead = T_map_camera[:, :3, 3], T_map_camera[:, :3, 2]
    for frame in np.unique(np.linspace(0, len(places) - 1, _PAIRS).astype(int)).tolist():
        near = np.linalg.norm(places - places[frame], axis=1) <= _NEAR * range_m
        others = np.flatnonzero(near & (ahead @ ahead[frame] >= _SAME_WAY))
        other = int(others[np.abs(others - frame).argmax()])
        if other != frame:
            yield frame, other


def disagreement(
    views: Iterable[tuple[PointCloud, PointCloud, Float64]], settings: OccupancySettings
) -> float:
    """Return the standard deviation of an inverse depth, 1/m, by how frames contradict each other.

    ``views`` are the rays of two frames each, and what takes the first ones into the axes of the
    others. It is that of matching, rig and path together, as far as they differ between frames; 0
    where nothing is seen twice. What moves counts, too, but not if it is less than half.
    """
    off = np.concatenate([np.zeros(0), *(_off(*view, settings) for view in views)])
    return _NORMAL * float(np.median(np.abs(off))) if len(off) else 0.0


def _off(one: PointCloud, other: PointCloud, T_other_one: Float64, s: OccupancySettings) -> Float64:
    """Return by how much two frames disagree about rays that both have, as inverse depths, 1/m."""
    hits = (np.linalg.norm(cloud.xyz, axis=1) <= s.max_range_m for cloud in (one, other))
    there, seen = (
        cloud.xyz[hit & (cloud.xyz[:, 2] > 0)].astype(np.float64)
        for cloud, hit in zip((one, other), hits, strict=True)
    )
    moved = apply(T_other_one, there)
    ahead = moved[:, 2] > s.resolution_m
    if not len(seen) or not ahead.any():
        return np.zeros(0)
    own, moved = there[ahead, 2], moved[ahead]
    apart, at = cKDTree(seen[:, :2] / seen[:, 2:]).query(moved[:, :2] / moved[:, 2:])
    same = apart * moved[:, 2] < s.resolution_m / 2
    found = seen[at[same], 2]
    return np.asarray((found - moved[same, 2]) / np.hypot(own[same] ** 2, found**2))


class Reaches:
    """How far one standard deviation moves what frames hit in cells, along their rays."""

    def __init__(self, keys: Int64, resolution_m: float, error: float) -> None:
        self._centres = (unpack_keys(keys) + 0.5) * resolution_m
        self._by_depth = error / resolution_m
        self._sums, self._hits = np.zeros((len(keys), 3)), np.zeros((len(keys), 1))

    def noting(self, looks: Iterable[tuple[Float64, Int8]]) -> Iterator[Int8]:
        """Yield what each frame saw (N,), of those at ``T_map_camera``, and note what it hit."""
        for T_map_camera, look in looks:
            hit = np.flatnonzero(look > 0)
            depth = apply(invert(T_map_camera), self._centres[hit])[:, 2:]
            self._sums[hit] += (self._centres[hit] - T_map_camera[:3, 3]) * depth
            self._hits[hit] += 1
            yield look

    @property
    def cells(self) -> Float64:
        """float64 (N, 3), mean of the frames that hit each cell, in cells; 0 where none did."""
        return np.asarray(self._by_depth * self._sums / np.maximum(self._hits, 1))


def still_there(keys: Int64, reach: Float64, occupied: Int64) -> Bool:
    """Return bool (N,), packed cells with one of the sorted occupied ones in reach (N, 3) cells."""
    places, found = unpack_keys(keys) + 0.5, find_keys(keys, occupied)[1]
    for ratio in np.linspace(0, 1, math.ceil(2 * np.abs(reach).max(initial=0)) + 1)[1:]:
        for sign in (-ratio, ratio):
            cells = np.floor(places + sign * reach).astype(np.int64)
            found |= find_keys(pack_keys(cells), occupied)[1]
    return np.asarray(found)
