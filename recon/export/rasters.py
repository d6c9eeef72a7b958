"""The map from above as GeoTIFFs, for programs of surveying and GIS.

North is up: the map is turned as the survey is, and what each tile has is written where it lies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply, invert
from recon.core.summary import inline
from recon.core.values import UNKNOWN, PointCloud
from recon.core.values.arrays import Bool, Float64, Int64
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.io.models.rasters import RasterFile, RasterPlace, write_geotiff
from recon.map.ground.surface import GroundSurface

_ROWS: Final = 256  # of a raster at a time
_CORNERS: Final = np.array([*product((0.0, 1.0), repeat=2)])
Fill = Callable[[ExportContext, RasterFile, Float64], None]


def stem_of(name: str) -> str:
    """Return the name of the file of one of `RASTERS`."""
    return name.removesuffix("-geotiff")


@dataclass(frozen=True)
class RasterFigures(ProductFigures):
    """The size of a raster."""

    size: Mapping[str, tuple[int, int]] = inline()  # columns and rows, by its key

    @property
    def text(self) -> str:
        return ", ".join(f"{columns} × {rows} cells" for columns, rows in self.size.values())


def raster_product(name: str) -> Callable[[ExportContext, Path], ExportResult]:
    """Return what writes one of `RASTERS`, perhaps in survey coordinates."""
    fill, colours = RASTERS[name]

    def write(context: ExportContext, path: Path) -> ExportResult:
        T_file_map = context.T_survey_map
        place = _place(context, T_file_map)
        with write_geotiff(path, place, colours=colours, crs=context.crs) as file:
            fill(context, file, T_file_map)
        size = (place.columns, place.rows)
        return ExportResult(RasterFigures({f"{stem_of(name)}_size": size}))

    return write


def _place(context: ExportContext, T_file_map: Float64) -> RasterPlace:
    """Return the cells that have all points, as large as those of the grid."""
    clouds = (tile.cloud.xyz.astype(np.float64) for tile in context.placed.tiles)
    seen = [apply(T_file_map, xyz)[:, :2] for xyz in clouds if len(xyz)]
    if not seen:
        raise MappingError("the map is empty: there is nothing to see from above")
    cell_m = context.placed.tiles.resolution_m
    west, south = np.floor(np.min([xy.min(axis=0) for xy in seen], axis=0) / cell_m).astype(int)
    east, north = np.floor(np.max([xy.max(axis=0) for xy in seen], axis=0) / cell_m).astype(int) + 1
    return RasterPlace(cell_m, int(west), int(north), int(east - west), int(north - south))


class _Seen(NamedTuple):
    """What is seen of a tile from above."""

    row: int  # first row of the raster
    column: int
    top: Int64  # (R, C), the highest point of each cell; -1 = none
    cloud: PointCloud
    height_m: Float64  # of its points

    @property
    def known(self) -> Bool:
        return np.asarray(self.top >= 0)


def _seen(context: ExportContext, place: RasterPlace, T_file_map: Float64) -> Iterator[_Seen]:
    for tile in context.placed.tiles:
        cloud = tile.cloud
        if not len(cloud):
            continue
        xyz = apply(T_file_map, cloud.xyz.astype(np.float64))
        row, column = place.cells_of(xyz[:, :2])
        first = int(row.min()), int(column.min())
        top = np.full((int(np.ptp(row)) + 1, int(np.ptp(column)) + 1), -1)
        # The last point that is written into a cell stays.
        upwards = np.argsort(xyz[:, 2], kind="stable")
        top[row[upwards] - first[0], column[upwards] - first[1]] = upwards
        yield _Seen(*first, top, cloud, xyz[:, 2])


def _surface_heights(context: ExportContext, file: RasterFile, T_file_map: Float64) -> None:
    """Write the height of the highest point of each cell."""
    for one in _seen(context, file.place, T_file_map):
        before = file.read(one.row, one.column, one.top.shape)
        heights = np.where(one.known, one.height_m[one.top], np.nan).astype(np.float32)
        file.write(one.row, one.column, np.fmax(before, heights))


def _surface_colours(context: ExportContext, file: RasterFile, T_file_map: Float64) -> None:
    """Write the colour of the highest point of each cell; where tiles meet, of the first tile."""
    for one in _seen(context, file.place, T_file_map):
        if one.cloud.rgb is None:
            raise MappingError("the points of the map have no colours")
        before = file.read(one.row, one.column, one.top.shape)
        opaque = np.where(one.known, 255, 0)[None]
        colours = np.where(one.known, one.cloud.rgb[one.top].transpose(2, 0, 1), 0)
        colours = np.concatenate([colours, opaque]).astype(np.uint8)
        file.write(one.row, one.column, np.where(before[3] > 0, before, colours))


def _ground_heights(ground: GroundSurface, xy_m: Float64, T_file_map: Float64) -> Float64:
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


def _ground(
    context: ExportContext,
    file: RasterFile,
    T_file_map: Float64,
    *,
    measure: Callable[[GroundSurface, Float64, Float64], Float64],
) -> None:
    """Write what is measured of the ground of each tile at the middles of cells."""
    T_map_file, place = invert(T_file_map), file.place
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
        inside, values = bounds.contains(xy_m), np.full(len(xy_m), np.nan, np.float32)
        values[inside] = measure(ground, xy_m[inside], T_file_map)
        file.write(*first, np.fmax(file.read(*first, shape), values.reshape(shape)))


RASTERS: Final[dict[str, tuple[Fill, bool]]] = {
    "dsm": (_surface_heights, False),
    "dtm": (partial(_ground, measure=_ground_heights), False),
    "slope": (partial(_ground, measure=lambda *at: np.degrees(ground_slopes(*at[:2]))), False),
    "orthophoto": (_surface_colours, True),
    "grid-geotiff": (_flat_grid, False),
}
"""What fills a raster, and whether it is one of colours."""
