"""The ground along a drive: a height map near the path that follows slopes and drift.

A drive of some hundred metres is never level: one degree of pitch in the first frame is three
metres after 170 m. So the surface starts below the path, one camera height down, and grows outward
ring by ring; each cell of a ring searches for ground only near the height of its inner neighbours.
Farther away, occupancy voxels show the ground, less precisely.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.core.errors import MappingError
from recon.core.kernels.voxels import find_keys, pack_keys
from recon.core.settings import Settings
from recon.core.values import OccupancyVoxels, PointCloud
from recon.core.values.arrays import Bool, Float32, Float64, Int64, freeze
from recon.core.values.grid import log_odds

BIN_M: Final = 0.05  # to which a height of the camera is known at best
_DEEPEST_M: Final = 5.0  # points farther below the path are not what the camera is carried on
_NEIGHBOURS: Final = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]
CELL_M: Final = 1.0  # least edge of a cell of the surface
_MOST_RINGS: Final = 500  # of cells around the path: in large scenes they are wider
WINDOW_M: Final = 0.3
"""Points this far from the expected height may be ground: also the largest step from one cell to
the next."""
MAX_TILT_DEG: Final = 35.0  # points with normals tilted more are no ground
MIN_POINTS: Final = 3  # points that make a measured cell
_MAX_GAP_M: Final = 4.0  # how far a height is carried over cells without points
_BEYOND: Final = np.iinfo(np.int32).max  # ring of the cells that are out of reach


class GroundSettings(Settings):
    """How the ground is followed."""

    camera_height_m: float | None = Field(None, ge=0.01, le=100.0)
    """Height of the camera above ground; none = measured. Set it where the ground near the path is
    not seen."""


class Raster(NamedTuple):
    """Square cells seen from above; row 0 has the smallest y."""

    origin_m: tuple[float, float]  # x and y of the outer corner of cell (0, 0)
    cell_m: float
    shape: tuple[int, int]  # rows, columns

    def cells_of(self, xy_m: Float64) -> tuple[Int64, Bool]:
        """Return the flat index of the cell of each place (N, 2), and whether there is one."""
        column, row = np.floor((xy_m - self.origin_m) / self.cell_m).astype(np.int64).T
        rows, columns = self.shape
        inside = (row >= 0) & (column >= 0) & (row < rows) & (column < columns)
        return row * columns + column, np.asarray(inside)


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """Height of the ground in map axes."""

    # float64 (rows, columns), z at the centre of each cell; NaN = unknown. Row 0 has the smallest
    # y, column 0 the smallest x.
    heights_m: Float64
    cell_m: float  # edge of a cell
    origin_m: tuple[float, float]  # (x, y) of the outer corner of cell (0, 0)
    # Height of the camera above the ground along the path; NaN = unknown
    camera_height_m: float = float("nan")
    # float64 (rows, columns), commonest height of the path above the points below it; NaN = too few
    # points, or no path. None = not measured.
    drops_m: Float64 | None = None
    # bool (rows, columns), whether points show the height: others are carried over from cells
    # beside. None = all.
    measured: Bool | None = None

    def __post_init__(self) -> None:
        freeze(self, "heights_m", np.float64, (None, None))
        freeze(self, "drops_m", np.float64, self.heights_m.shape)
        freeze(self, "measured", np.bool_, self.heights_m.shape)

    def height_at(self, xy: NDArray[Any]) -> Float64:
        """Return heights at places (N, 2), bilinear; NaN where that of their cell is unknown."""
        place = (np.asarray(xy, dtype=np.float64) - self.origin_m) / self.cell_m
        column, row = place[:, 0], place[:, 1]
        own = self._cells(np.floor(row), np.floor(column))
        top, left = np.floor(row - 0.5), np.floor(column - 0.5)
        v, u = row - 0.5 - top, column - 0.5 - left
        total, weight = np.zeros(len(place)), np.zeros(len(place))
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            height = self._cells(top + down, left + right)
            w = np.where(down, v, 1 - v) * np.where(right, u, 1 - u) * np.isfinite(height)
            total += w * np.nan_to_num(height)
            weight += w
        known = np.isfinite(own) & (weight > 0)
        return np.where(known, total / np.where(known, weight, 1.0), np.nan)

    def drop_at(self, xy: NDArray[Any]) -> Float64:
        """Return `drops_m` of the cells of places (N, 2); float64 (N,), NaN = unknown."""
        if self.drops_m is None:
            return np.full(len(xy), np.nan)
        row, column = self._place(xy)
        return self._cells(row, column, self.drops_m)

    def measured_at(self, xy: NDArray[Any]) -> Bool:
        """Return bool (N,), whether points show the height of the cells of places (N, 2)."""
        values = self.heights_m if self.measured is None else np.where(self.measured, 1, np.nan)
        row, column = self._place(xy)
        return np.isfinite(self._cells(row, column, values))

    def _place(self, xy: NDArray[Any]) -> Float64:
        """Return float64 (2, N), rows and columns of the cells of places (N, 2)."""
        column, row = np.floor((np.asarray(xy, np.float64) - self.origin_m) / self.cell_m).T
        return np.stack([row, column])

    def _cells(self, row: Float64, column: Float64, values: Float64 | None = None) -> Float64:
        """Return values of cells, by default heights; NaN outside the surface."""
        values = self.heights_m if values is None else values
        rows, columns = values.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        r, c = np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)
        return np.where(inside, values[r, c], np.nan)


def estimate_ground_surface(
    cloud: PointCloud, positions_m: NDArray[Any], settings: GroundSettings, reach_m: float
) -> GroundSurface:
    """Follow the ground along a path and to its sides; unknown everywhere without ground below it.

    Of a fused cloud with normals, only points that face up count. ``positions_m``, float (N, 3),
    are those of the camera, map axes; a row of NaN separates pieces of a path. The surface grows as
    far from the path as ``reach_m``.
    """
    field = _field(cloud, positions_m, reach_m)
    camera_height = settings.camera_height_m or field.camera_height()
    if math.isfinite(camera_height):
        field.grow(camera_height)
    # The known heights are blurred with their neighbours; carried ones count a tenth.
    known = np.isfinite(field.heights)
    weight = known * np.where(field.measured, 1.0, 0.1)
    total = cv2.GaussianBlur(weight * np.nan_to_num(field.heights), (5, 5), 1.0)
    sums = cv2.GaussianBlur(weight, (5, 5), 1.0)
    return GroundSurface(
        heights_m=np.where(known, total / np.where(known, sums, 1.0), np.nan),
        cell_m=field.cell_m,
        origin_m=field.origin,
        camera_height_m=camera_height,
        drops_m=field.drops(),
        measured=known & field.measured,
    )


def measure_camera_height(
    cloud: PointCloud, positions_m: NDArray[Any], reach_m: float
) -> tuple[float, Float64]:
    """Return the commonest height of the camera above the ground, and that in cells of the path.

    NaN where no ground was found; cells, float64 (C,), are those with points below the path. Takes
    what `estimate_ground_surface` does.
    """
    field = _field(cloud, positions_m, reach_m)
    drops = field.drops()
    return field.camera_height(), drops[np.isfinite(drops)]


def _field(cloud: PointCloud, positions_m: NDArray[Any], reach_m: float) -> _Field:
    if cloud.frame != "map":
        raise MappingError("ground is looked for in map axes", got=cloud.frame, expected="map")
    if not np.isfinite(positions_m).any():
        raise MappingError("ground is looked for below a path, and the path is empty")
    return _Field(cloud, np.asarray(positions_m, dtype=np.float64), reach_m)


class _Field:
    """The surface while it grows."""

    def __init__(self, cloud: PointCloud, path: Float64, reach_m: float) -> None:
        self.cell_m = cell = max(CELL_M, reach_m / _MOST_RINGS)
        rings = math.ceil(reach_m / cell)
        known = np.isfinite(path).all(axis=1)
        pieces = np.split(path, np.flatnonzero(np.diff(known)) + 1)
        known_pieces = [one for one in pieces if len(one) and np.isfinite(one[0]).all()]
        path = np.concatenate([_densify(piece, cell / 2) for piece in known_pieces])
        low = np.floor(path[:, :2].min(axis=0) / cell) - rings
        columns, rows = (np.floor(path[:, :2].max(axis=0) / cell) - low + rings + 1).astype(int)
        self.origin = (float(low[0] * cell), float(low[1] * cell))
        self._raster = Raster(self.origin, cell, (rows, columns))
        self.heights = np.full((rows, columns), np.nan)
        self.measured = np.zeros((rows, columns), dtype=np.bool_)
        self._gap = np.full((rows, columns), np.inf)
        # Mean height of the path in each cell that it crosses; NaN elsewhere.
        cells, _ = self._raster.cells_of(path[:, :2])
        number = np.bincount(cells, minlength=rows * columns)
        total = np.bincount(cells, weights=path[:, 2], minlength=rows * columns)
        mean = np.where(number > 0, total / np.maximum(number, 1), np.nan)
        self._path_z = mean.reshape(self.heights.shape)
        # Steps, to 8 neighbours, from the nearest cell below the path.
        away = np.where(np.isfinite(self._path_z), 0, 255).astype(np.uint8)
        steps = np.rint(cv2.distanceTransform(away, cv2.DIST_C, 3)).astype(np.int32)
        self._ring = np.where(steps <= rings, steps, _BEYOND).astype(np.int32)
        self._cell, self._z = self._points(cloud)

    def camera_height(self) -> float:
        """Return the commonest height of the path above the points near it; NaN without points."""
        near = self._ring.ravel()[self._cell] == 0
        drop = self._path_z.ravel()[self._cell[near]] - self._z[near]
        drop = drop[(drop > 2 * BIN_M) & (drop < _DEEPEST_M)]
        if len(drop) < MIN_POINTS:
            return math.nan
        votes = np.bincount((drop / BIN_M).astype(int), minlength=3)
        smooth = np.convolve(votes, [1, 1, 1], mode="same")
        mode = (int(np.argmax(smooth)) + 0.5) * BIN_M
        return float(np.median(drop[np.abs(drop - mode) < 3 * BIN_M]))

    def drops(self) -> Float64:
        """Return the commonest height of the path above the points of each cell; NaN = none."""
        drop = self._path_z.ravel()[self._cell] - self._z
        below = (drop > 2 * BIN_M) & (drop < _DEEPEST_M)
        found = np.full(self.heights.size, np.nan)
        cells, slot = np.unique(self._cell[below], return_inverse=True)
        bins = math.ceil(_DEEPEST_M / BIN_M)
        place = slot * bins + (drop[below] / BIN_M).astype(int)
        votes = np.bincount(place, minlength=len(cells) * bins).reshape(-1, bins)
        wide = np.pad(votes, ((0, 0), (1, 1)))
        smooth = wide[:, :-2] + votes + wide[:, 2:]
        mode = (smooth.argmax(axis=1) + 0.5) * BIN_M
        enough = smooth.max(axis=1, initial=0) >= MIN_POINTS
        found[cells[enough]] = mode[enough]
        return np.asarray(found.reshape(self.heights.shape))

    def grow(self, camera_height_m: float) -> None:
        """Fill ring after ring, from the path outward."""
        ring_of_point = self._ring.ravel()[self._cell]
        order = np.argsort(ring_of_point, kind="stable")
        last = int(self._ring[self._ring < _BEYOND].max())
        bounds = np.searchsorted(ring_of_point[order], np.arange(last + 2))
        for ring in range(last + 1):
            cells = np.flatnonzero(self._ring.ravel() == ring)
            if ring == 0:
                expected, gap = self._path_z.ravel()[cells] - camera_height_m, np.zeros(len(cells))
            else:
                expected, gap = self._from_neighbours(cells)
            self._fill_ring(cells, expected, gap, order[bounds[ring] : bounds[ring + 1]])

    def _fill_ring(
        self, cells: NDArray[np.intp], expected: Float64, gap: Float64, points: NDArray[np.intp]
    ) -> None:
        slot = np.searchsorted(cells, self._cell[points])
        z = self._z[points]
        height = expected
        for width in (WINDOW_M, WINDOW_M / 2):
            near = np.abs(z - height[slot]) <= width
            number = np.bincount(slot[near], minlength=len(cells))
            total = np.bincount(slot[near], weights=z[near], minlength=len(cells))
            found = number >= MIN_POINTS
            height = np.where(found, total / np.maximum(number, 1), height)
        gap = np.where(found, 0.0, gap + self.cell_m)
        lost = gap > _MAX_GAP_M
        self.heights.ravel()[cells] = np.where(lost, np.nan, height)
        self.measured.ravel()[cells] = found
        self._gap.ravel()[cells] = gap

    def _from_neighbours(self, cells: NDArray[np.intp]) -> tuple[Float64, Float64]:
        """Return mean height of the known neighbours of cells, and their smallest gap."""
        rows, columns = np.divmod(cells, self.heights.shape[1])
        total, number = np.zeros(len(cells)), np.zeros(len(cells))
        gap = np.full(len(cells), np.inf)
        for down, right in _NEIGHBOURS:
            r = np.clip(rows + down, 0, self.heights.shape[0] - 1)
            c = np.clip(columns + right, 0, self.heights.shape[1] - 1)
            height = self.heights[r, c]
            known = np.isfinite(height)
            total += np.where(known, height, 0.0)
            number += known
            gap = np.where(known, np.minimum(gap, self._gap[r, c]), gap)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan), gap

    def _points(self, cloud: PointCloud) -> tuple[NDArray[np.intp], Float64]:
        xyz = cloud.xyz.astype(np.float64)
        if cloud.normals is not None:
            upright = math.cos(math.radians(MAX_TILT_DEG))
            xyz = xyz[cloud.normals[:, 2] >= upright]
        cells, inside = self._raster.cells_of(xyz[:, :2])
        cells, z = cells[inside], xyz[inside, 2]
        reached = self._ring.ravel()[cells] < _BEYOND
        return cells[reached], z[reached]


def _densify(path: Float64, step_m: float) -> Float64:
    """Return the path with points at most ``step_m`` apart."""
    if len(path) == 1:
        return path
    pieces = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(pieces)])
    wanted = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / step_m) + 1))
    return np.stack([np.interp(wanted, along, path[:, axis]) for axis in range(3)], axis=1)


_FULL: Final = log_odds(0.6)
_EMPTY: Final = log_odds(0.45)
_REACH: Final = 2
"""Evidence of a floor may be split over two voxels, so the free one may be the second above."""


def find_floors(voxels: OccupancyVoxels) -> Float32:
    """Return float32 (N, 3), centres of the occupied voxels with free space right above them."""
    packed = pack_keys(voxels.keys)
    order = np.argsort(packed)
    packed, log_odds = packed[order], voxels.log_odds[order]
    full = np.flatnonzero(log_odds > _FULL)
    free, roofed = np.zeros((2, len(full)), np.bool_)
    for up in range(1, _REACH + 1):
        place, observed = find_keys(packed[full] + up, packed)
        free |= observed & ~roofed & (log_odds[place] < _EMPTY)
        roofed |= observed & (log_odds[place] > _FULL)
    floors = voxels.keys[order[full[free]]]
    return ((floors + 0.5) * voxels.resolution_m).astype(np.float32)


def add_floors(cloud: PointCloud, floors: Float32) -> PointCloud:
    """Return a cloud to look for ground in: its points, and floors (N, 3) where it has too few."""
    known = cloud.xyz
    if cloud.normals is not None:
        known = known[cloud.normals[:, 2] >= math.cos(math.radians(MAX_TILT_DEG))]
    cells, counts = np.unique(_columns(known), return_counts=True)
    floors = floors[np.isin(_columns(floors), cells[counts >= MIN_POINTS], invert=True)]
    xyz = np.concatenate([cloud.xyz, floors])
    if cloud.normals is None:
        return PointCloud(xyz, frame=cloud.frame)
    up = np.tile(np.array([0, 0, 1], np.float32), (len(floors), 1))
    return PointCloud(xyz, normals=np.concatenate([cloud.normals, up]), frame=cloud.frame)


def _columns(xyz: Float32) -> Int64:
    """Return one number for each point's cell of the ground."""
    cells = np.floor(xyz[:, :2].astype(np.float64) / CELL_M).astype(np.int64)
    return np.asarray((cells[:, 0] << 32) + cells[:, 1])
