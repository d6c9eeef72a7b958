"""Points from which the ground of a drive is estimated, stored on disk tile by tile."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.core.values import PointCloud
from recon.core.values.arrays import Float32, Float64
from recon.io.tree_file import read_tree, write_tree
from recon.map import add_floors
from recon.map.drive_map import Tile
from recon.map.ground import MAX_TILT_DEG


@dataclass(frozen=True)
class Window:
    """A rectangle of the map.

    Attributes:
        low: Smallest x and y, metres.
        high: Largest x and y, metres.
    """

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def around(cls, tile: Tile, edge_m: float, margin_m: float) -> Window:
        """A tile with a margin around it."""
        column, row = tile
        return cls(
            (column * edge_m - margin_m, row * edge_m - margin_m),
            ((column + 1) * edge_m + margin_m, (row + 1) * edge_m + margin_m),
        )

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which points (N, 2 or 3) lie in the window."""
        return np.asarray(((points[:, :2] >= self.low) & (points[:, :2] < self.high)).all(axis=1))

    def meets(self, other: Window) -> bool:
        """Whether two windows overlap."""
        sides = zip(self.low, self.high, other.low, other.high, strict=True)
        return all(
            low <= their_high and their_low <= high for low, high, their_low, their_high in sides
        )

    def path(self, path_m: Float64) -> Float64:
        """The pieces of a path (N, 3) inside, with a row of NaN after each piece that leaves."""
        inside = self.contains(path_m)
        leaves = np.r_[False, inside[:-1]] & ~inside
        return np.asarray(np.where(inside[:, None], path_m, np.nan)[inside | leaves])


class GroundStore:
    """Candidate ground points of one run, map axes, in files.

    Args:
        folder: The folder of the files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._boxes: dict[str, Window] = {}
        self._parts: Counter[Tile] = Counter()

    def put_cloud(self, tile: Tile, cloud: PointCloud) -> None:
        """Store a tile of the fused cloud, or a part of it; with normals, only points facing up.

        Raises:
            OutputError: It cannot be written.
        """
        xyz = cloud.xyz
        if cloud.normals is not None:
            upright = math.cos(math.radians(MAX_TILT_DEG))
            xyz = xyz[cloud.normals[:, 2] >= upright]
        self._parts[tile] += 1
        self._put(f"cloud_{tile[0]}_{tile[1]}_{self._parts[tile]}", xyz)

    def put_floors(self, tile: Tile, xyz: Float32) -> None:
        """Store the floors of a tile of voxels.

        Raises:
            OutputError: It cannot be written.
        """
        self._put(f"floors_{tile[0]}_{tile[1]}", xyz)

    def cloud_in(self, window: Window) -> PointCloud:
        """Candidate ground points in a window, frame ``map``."""
        points, floors = (self._read(kind, window) for kind in ("cloud", "floors"))
        return add_floors(PointCloud(points, frame="map"), floors)

    def _put(self, name: str, xyz: Float32) -> None:
        if len(xyz):
            low, high = xyz[:, :2].min(axis=0).tolist(), xyz[:, :2].max(axis=0).tolist()
            self._boxes[name] = Window((low[0], low[1]), (high[0], high[1]))
            write_tree(self._folder / f"{name}.zip", {"xyz": xyz})

    def _read(self, kind: str, window: Window) -> Float32:
        """float32 (N, 3), the points of one kind in a window."""
        found = [np.zeros((0, 3), np.float32)]
        for name, box in self._boxes.items():
            if name.startswith(kind) and window.meets(box):
                xyz = read_tree(self._folder / f"{name}.zip")["xyz"]
                found.append(xyz[window.contains(xyz)])
        return np.concatenate(found)
