"""Signed distances to what is occupied, for planners in 3-D (a Euclidean signed distance field).

A voxel is a cube that is free, occupied or unknown, as in an OctoMap. In free space, the distance
is that to the nearest occupied cube; in an occupied cube it is negative, to the nearest free one.
Unknown space has none, and is neither: it may hide obstacles that are nearer than those seen.

Ref: H. Oleynikova et al., "Voxblox: incremental 3D Euclidean signed distance fields for on-board
MAV planning", IROS 2017.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from recon.core.errors import MappingError
from recon.core.kernels.voxels import KEY_LIMIT, find_keys, pack_keys
from recon.core.values.arrays import Bool, Float32, Float64, Int32, Int64
from recon.map.cut import TileKey
from recon.map.ground.grid import drop_undecided
from recon.map.tiles import Tiles

_MAX_DISTANCE_M: Final = 5.0
"""Distances end here, on a road: at 5 m/s a robot that brakes at 2.5 m/s² stops within. Farther
obstacles change no path, and cost memory, as each tile needs a margin so wide."""
_CORNER: Final = math.sqrt(0.75)  # how far from its centre a cube reaches, in cells
_NEAREST: Final = 8  # centres whose cubes are looked at first
_AT_ONCE: Final = 1 << 13  # places whose centres are in memory
_KEPT_TILES: Final = 9
_NOWHERE: Final = 1e9
_TINY: Final = 1e-9


_Around = tuple[Int64, Bool, cKDTree, cKDTree]
"""Known voxels of a tile and its margin: packed and sorted (N,), which are occupied, and the
centres of the free ones and of the occupied ones, in cells."""


class DistanceField:
    """The distances of a map in tiles, made where they are asked for.

    A distance ends at ``max_distance_m``: one of so much means that, or more.

    Raises:
        MappingError: Nothing was observed.
    """

    def __init__(self, tiles: Tiles) -> None:
        if tiles.extent[0] == tiles.extent[1]:
            raise MappingError("nothing was observed: there is nothing to keep a distance from")
        self.tiles = tiles
        self.max_distance_m = tiles.config.scale * _MAX_DISTANCE_M
        self._kept = lru_cache(_KEPT_TILES)(self._around)

    def at(self, places_m: Float64) -> tuple[Float64, Float64]:
        """Return distances (N,), metres, and their gradients (N, 3), of places (N, 3), map axes.

        A gradient has length 1 and leads away from the obstacle; it is 0 where the distance ends.
        Both are NaN in unknown space.
        """
        distance_m, gradient = np.full(len(places_m), np.nan), np.full(places_m.shape, np.nan)
        cells = np.floor(places_m / self.tiles.resolution_m)
        known = np.flatnonzero((np.abs(cells) < KEY_LIMIT).all(axis=1))
        homes = (cells[known, :2] // self.tiles.edge_cells).astype(np.int64)
        for x, y in np.unique(homes, axis=0).tolist():
            rows = known[(homes == (x, y)).all(axis=1)]
            distance_m[rows], gradient[rows] = self._measured(self._kept((x, y)), places_m[rows])
        return distance_m, gradient

    def of_tile(self, key: TileKey) -> tuple[Int32, Float32]:
        """Return the known voxels (N, 3) of a tile, and the distance of the centre of each."""
        voxels = drop_undecided(self.tiles.voxels(key))
        return voxels.keys, self._measured(self._around(key), voxels.centres_m)[0].astype("f4")

    def _around(self, key: TileKey) -> _Around:
        reach_m = self.max_distance_m + self.tiles.resolution_m
        voxels = drop_undecided(self.tiles.voxels_in(self.tiles.bounds(key).wider(reach_m)))
        packed, occupied = pack_keys(voxels.keys), voxels.log_odds > 0
        order = np.argsort(packed)
        free, full = (cKDTree(voxels.keys[one] + 0.5) for one in (~occupied, occupied))
        return packed[order], occupied[order], free, full

    def _measured(self, around: _Around, places_m: Float64) -> tuple[Float64, Float64]:
        places = places_m / self.tiles.resolution_m
        keys, occupied, *trees = around
        found, known = find_keys(pack_keys(np.floor(places).astype(np.int64)), keys)
        inside = known & occupied[found] if len(keys) else known
        distance, gradient = np.full(len(places), np.nan), np.full(places.shape, np.nan)
        for which, tree, sign in zip((inside, known & ~inside), trees, (-1, 1), strict=True):
            rows = np.flatnonzero(which)
            for some in np.split(rows, range(_AT_ONCE, len(rows), _AT_ONCE)):
                away = self._away(tree, places[some])
                length = np.linalg.norm(away, axis=1)
                distance[some] = sign * length
                gradient[some] = sign * away / length[:, None]
        most = self.max_distance_m / self.tiles.resolution_m
        gradient[np.abs(distance) >= most] = 0
        return np.clip(distance, -most, most) * self.tiles.resolution_m, gradient

    def _away(self, tree: cKDTree, places: Float64) -> Float64:
        """Return (N, 3), what leads to places from the nearest cube with its centre in a tree."""
        most = self.max_distance_m / self.tiles.resolution_m + _CORNER
        centres = np.concatenate([tree.data, np.full((1, 3), _NOWHERE)])
        found, rows, number = np.empty_like(places), np.arange(len(places)), _NEAREST
        while len(rows):
            length, nearest = tree.query(places[rows], number, distance_upper_bound=most)
            off = places[rows, None] - centres[nearest]
            away = np.sign(off) * np.maximum(np.abs(off) - 0.5, 0)
            best = np.arange(len(rows)), np.linalg.norm(away, axis=2).argmin(axis=1)
            off, away = off[best], away[best]
            # What is on a face is as if just before it, so that there is a direction.
            farthest = np.abs(off) == np.abs(off).max(axis=1, keepdims=True)
            on_face = ~away.any(axis=1, keepdims=True) & farthest
            found[rows] = np.where(on_face, _TINY * off, away)
            # The cube of a centre that is farther than all these may still be nearer.
            rows = rows[np.linalg.norm(away, axis=1) > length[:, -1] - _CORNER]
            number *= 4
        return found
