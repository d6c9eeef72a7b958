"""Points and voxels from which a drive is meshed, stored on disk tile by tile."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values import OccupancyVoxels, PointCloud
from recon.io.tree_file import read_tree, write_tree
from recon.map.drive_map import Tile, join_clouds

_NUMBERS = frozenset({"xyz", "rgb", "normals"})


class TileStore:
    """Points and voxels in map axes, in tiles centred at multiples of the edge length.

    Args:
        folder: Folder for the files of one run.
        tile_m: Edge length of a tile.
    """

    def __init__(self, folder: Path, tile_m: float) -> None:
        self._folder = folder
        self.tile_m = tile_m
        self._points: dict[Tile, int] = defaultdict(int)
        self._parts: dict[tuple[str, Tile], list[Path]] = defaultdict(list)
        self._resolution_m = 0.0

    @property
    def tiles(self) -> list[Tile]:
        """The tiles that hold points, in order."""
        return sorted(self._points)

    @property
    def total(self) -> int:
        """Number of points in all tiles."""
        return sum(self._points.values())

    def points(self, tile: Tile) -> int:
        """Number of points in a tile."""
        return self._points.get(tile, 0)

    def bounds_m(self, tile: Tile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Smallest and largest x and y of a tile. Tile (0, 0) is centred at the map's origin."""
        middle = np.array(tile, dtype=np.float64) * self.tile_m
        return middle - self.tile_m / 2, middle + self.tile_m / 2

    def put_cloud(self, cloud: PointCloud) -> None:
        """Store points.

        Raises:
            OutputError: They cannot be written.
        """
        for tile, rows in self._split(cloud.xyz):
            self._points[tile] += len(rows)
            part = cloud.select(rows)
            known = [f.name for f in fields(part) if f.name in _NUMBERS]
            arrays = {name: getattr(part, name) for name in known}
            self._put("cloud", tile, {k: v for k, v in arrays.items() if v is not None})

    def put_voxels(self, voxels: OccupancyVoxels) -> None:
        """Store voxels; all must have the same resolution.

        Raises:
            OutputError: They cannot be written.
        """
        self._resolution_m = voxels.resolution_m
        for tile, rows in self._split(voxels.centres_m):
            arrays = {"keys": voxels.keys[rows], "log_odds": voxels.log_odds[rows]}
            self._put("voxels", tile, arrays)

    def cloud_in(self, tile: Tile, margin_m: float) -> PointCloud | None:
        """The points in a tile and within a margin of it, frame ``map``; None = no points."""
        low, high = self.bounds_m(tile)
        parts = []
        for found in self._read("cloud", tile, margin_m):
            xy = found["xyz"][:, :2]
            inside = ((xy >= low - margin_m) & (xy < high + margin_m)).all(axis=1)
            parts.append(PointCloud(frame="map", **{k: v[inside] for k, v in found.items()}))
        return join_clouds(parts)

    def voxels_in(self, tile: Tile, margin_m: float) -> OccupancyVoxels:
        """The voxels of a tile and of all tiles that its margin touches."""
        keys, log_odds = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.float32)]
        for found in self._read("voxels", tile, margin_m):
            keys.append(found["keys"])
            log_odds.append(found["log_odds"])
        return OccupancyVoxels(np.concatenate(keys), np.concatenate(log_odds), self._resolution_m)

    def _split(self, xyz: NDArray[Any]) -> list[tuple[Tile, NDArray[np.intp]]]:
        """The tiles that contain points, each with the row indices of its points."""
        homes = np.floor(xyz[:, :2] / self.tile_m + 0.5).astype(np.int64)
        tiles, where = np.unique(homes, axis=0, return_inverse=True)
        return [
            ((int(column), int(row)), np.flatnonzero(where.ravel() == n))
            for n, (column, row) in enumerate(tiles)
        ]

    def _put(self, kind: str, tile: Tile, arrays: dict[str, Any]) -> None:
        parts = self._parts[kind, tile]
        path = self._folder / f"{kind}_{tile[0]}_{tile[1]}_{len(parts)}.zip"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_tree(path, arrays)
        parts.append(path)

    def _read(self, kind: str, tile: Tile, margin_m: float) -> list[dict[str, Any]]:
        """The stored parts of a tile and of the tiles within a margin of it."""
        reach = int(np.ceil(margin_m / self.tile_m))
        steps = range(-reach, reach + 1)
        near = [(tile[0] + column, tile[1] + row) for column in steps for row in steps]
        return [read_tree(path) for home in near for path in self._parts.get((kind, home), ())]
