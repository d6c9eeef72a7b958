"""The map from above as GeoTIFFs, for programs of surveying and GIS.

North is up: the map is turned as the survey is, and what each tile has is written where it lies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply, invert
from recon.core.summary import inline, optional
from recon.core.values import UNKNOWN
from recon.core.values.arrays import Float64
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.io.models.rasters import RasterFile, RasterPlace, write_geotiff
from recon.map.ground.surface import GroundSurface

_ROWS: Final = 256  # of a raster at a time
_CORNERS: Final = np.array([*product((0.0, 1.0), repeat=2)])
Fill = Callable[[ExportContext, RasterFile, Float64], None]
Measure = Callable[[GroundSurface, Float64, Float64], Float64]
"""Measures a ground at places (N, 2) of a map, given what leads to the file: (N,)."""


def stem_of(name: str) -> str:
    """Return the name of the file of one of `RASTERS`."""
    return name.removesuffix("-geotiff")


@dataclass(frozen=True)
class RasterFigures(ProductFigures):
    """The size of a raster."""

    size: Mapping[str, tuple[int, int]] = inline()  # columns and rows, by its key
    gsd_m: float | None = optional()  # edge of a cell of the orthophoto

    @property
    def text(self) -> str:
        cells = ", ".join(f"{columns} × {rows} cells" for columns, rows in self.size.values())
        return cells if self.gsd_m is None else f"{cells} of {self.gsd_m:g} m"


def raster_product(name: str) -> Callable[[ExportContext, Path], ExportResult]:
    """Return what writes one of `RASTERS`, perhaps in survey coordinates."""
    fill, unit, bands = RASTERS[name]

    def write(context: ExportContext, path: Path) -> ExportResult:
        place = place_of(context, context.placed.tiles.resolution_m)
        with write_geotiff(path, place, bands=bands, unit=unit, crs=context.crs) as file:
            fill(context, file, context.T_survey_map)
        size = (place.columns, place.rows)
        return ExportResult(RasterFigures({f"{stem_of(name)}_size": size}))

    return write


def place_of(context: ExportContext, cell_m: float) -> RasterPlace:
    """Return cells, north up in the coordinates of the survey, that have all points of the map."""
    clouds = (tile.cloud.xyz.astype(np.float64) for tile in context.placed.tiles)
    seen = [apply(context.T_survey_map, xyz)[:, :2] for xyz in clouds if len(xyz)]
    if not seen:
        raise MappingError("the map is empty: there is nothing to see from above")
    west, south = np.floor(np.min([xy.min(axis=0) for xy in seen], axis=0) / cell_m).astype(int)
    east, north = np.floor(np.max([xy.max(axis=0) for xy in seen], axis=0) / cell_m).astype(int) + 1
    return RasterPlace(cell_m, int(west), int(north), int(east - west), int(north - south))


def columns_of(
    place: RasterPlace, xyz: Float64, weight: NDArray[Any] | float
) -> tuple[tuple[slice, slice], Callable[[NDArray[Any] | float], Float64]]:
    """Return the cells around points (N, 3), and what sums up values (N,) of the uppermost there.

    These are no lower than the highest by more than a cell is wide: of one surface, if it is no
    steeper than 45°. Values are multiplied by the weights; sums are (rows, columns).
    """
    row, column = place.cells_of(xyz[:, :2])
    at = np.s_[row.min() : row.max() + 1, column.min() : column.max() + 1]
    shape = int(np.ptp(row)) + 1, int(np.ptp(column)) + 1
    cell = np.ravel_multi_index((row - row.min(), column - column.min()), shape)
    top = np.full(shape, -np.inf)
    np.maximum.at(top.ravel(), cell, xyz[:, 2])
    counted = weight * (xyz[:, 2] >= top.ravel()[cell] - place.cell_m)

    def total(values: NDArray[Any] | float) -> Float64:
        return np.bincount(cell, counted * values, top.size).astype(np.float64).reshape(shape)

    return at, total


def _surface_heights(context: ExportContext, file: RasterFile, T_file_map: Float64) -> None:
    """Write the height of the highest point of each cell; elsewhere that of the ground, marked."""
    for cloud in filter(len, (tile.cloud for tile in context.placed.tiles)):
        xyz = apply(T_file_map, cloud.xyz.astype(np.float64))
        row, column = file.place.cells_of(xyz[:, :2])
        first = int(row.min()), int(column.min())
        top = np.full((2, int(np.ptp(row)) + 1, int(np.ptp(column)) + 1), np.nan, np.float32)
        np.fmax.at(top[0], (row - first[0], column - first[1]), xyz[:, 2])
        top[1, ~np.isnan(top[0])] = 1.0
        file.write(*first, np.fmax(file.read(*first, top.shape[1:]), top))
    _ground(context, file, T_file_map, measure=ground_heights, shown=False)


def ground_heights(ground: GroundSurface, xy_m: Float64, T_file_map: Float64) -> Float64:
    """Return the heights (N,) of the ground in a file, at places (N, 2) of the map."""
    xyz = np.column_stack([xy_m, ground.height_at(xy_m)])
    return np.asarray(apply(T_file_map, xyz)[:, 2])


def ground_slopes(ground: GroundSurface, xy_m: Float64) -> Float64:
    """Return the slope [rad] at places (N, 2), over a cell of the ground to either side."""
    sides = ground.cell_m * np.eye(2)
    rises = [ground.height_at(xy_m + side) - ground.height_at(xy_m - side) for side in sides]
    return np.asarray(np.arctan(np.hypot(*rises) / (2 * ground.cell_m)))


def _flat_grid(context: ExportContext, file: RasterFile, T_file_map: Float64) -> None:
    """Write what the flat grid has at the middle of each cell: 0 = free, 100 = occupied."""
    grid, T_map_file, place = Flattening(context.placed).grid()[0], invert(T_file_map), file.place
    for row in range(0, place.rows, _ROWS):
        shape = min(_ROWS, place.rows - row), place.columns
        middles = place.centres(row, 0, shape).reshape(-1, 2)
        level = np.full((len(middles), 1), T_file_map[2, 3])
        xy_m = apply(T_map_file, np.hstack([middles, level]))[:, :2]
        i, j = np.floor((xy_m - grid.origin_m) / grid.resolution_m).astype(int)[:, ::-1].T
        inside = (i >= 0) & (j >= 0) & (i < grid.cells.shape[0]) & (j < grid.cells.shape[1])
        values = np.full(len(xy_m), np.nan, np.float32)
        cells = grid.cells[i[inside], j[inside]]
        values[inside] = np.where(cells == UNKNOWN, np.nan, cells)
        file.write(row, 0, values.reshape(1, *shape))


def ground_blocks(
    context: ExportContext, place: RasterPlace, measure: Measure
) -> Iterator[tuple[int, int, Float64]]:
    """Yield blocks with a row and a column: what is measured of the ground at middles of cells.

    float64 (2, rows, columns): NaN = unknown, or not of this block; and whether points show it (1),
    or it was carried over from cells beside (0).
    """
    T_file_map = context.T_survey_map
    T_map_file = invert(T_file_map)
    for bounds, ground in Flattening(context.placed).grounds():
        low, high = np.array(bounds.low), np.array(bounds.high)
        corners = np.pad(low + _CORNERS * (high - low), ((0, 0), (0, 1)))
        row, column = place.cells_of(apply(T_file_map, corners)[:, :2])
        row, column = np.clip(row, 0, place.rows - 1), np.clip(column, 0, place.columns - 1)
        first = int(row.min()), int(column.min())
        shape = (int(np.ptp(row)) + 1, int(np.ptp(column)) + 1)
        middles = place.centres(*first, shape).reshape(-1, 2)
        # The map's own level, for the place of a cell in a map that is tilted against the survey.
        level = np.full((len(middles), 1), T_file_map[2, 3])
        xy_m = apply(T_map_file, np.hstack([middles, level]))[:, :2]
        inside, values = bounds.contains(xy_m), np.full((2, len(xy_m)), np.nan)
        values[0, inside] = measure(ground, xy_m[inside], T_file_map)
        values[1, inside] = ground.measured_at(xy_m[inside])
        values[1, np.isnan(values[0])] = np.nan
        yield *first, values.reshape(2, *shape)


def _ground(
    context: ExportContext, file: RasterFile, _: Float64, *, measure: Measure, shown: bool = True
) -> None:
    """Write what is measured of the ground where nothing is yet, perhaps as not ``shown``."""
    for row, column, values in ground_blocks(context, file.place, measure):
        before = file.read(row, column, values.shape[1:])
        values[1] *= shown
        file.write(row, column, np.where(np.isnan(before), values, before).astype(np.float32))


RASTERS: Final[dict[str, tuple[Fill, str, tuple[str, ...]]]] = {
    "dsm": (_surface_heights, "metre", ("height", "measured")),
    "dtm": (partial(_ground, measure=ground_heights), "metre", ("height", "measured")),
    "slope": (
        partial(_ground, measure=lambda *at: np.degrees(ground_slopes(*at[:2]))),
        "degree",
        ("slope", "measured"),
    ),
    "grid-geotiff": (_flat_grid, "percent", ("occupied",)),
}
"""What fills a raster, the unit of its first band, and the names of all."""
