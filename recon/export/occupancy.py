"""The occupancy of a map as files: OctoMap and distances in 3-D, a flat grid for navigation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MappingError
from recon.core.progress import tracked
from recon.core.text import metres
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, PointCloud
from recon.core.values.arrays import Float64, Int32, Int64
from recon.core.values.grid import log_odds
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.io.models.columns import write_npz
from recon.io.models.octomap import write_octomap_tiles
from recon.io.models.rasters import write_nav2
from recon.map.builders import MIN_PROBABILITY
from recon.map.cut import Rectangle, TileKey
from recon.map.esdf import DistanceField
from recon.map.ground.axes import base_axes
from recon.map.ground.grid import (
    DrivenPath,
    GridSettings,
    drop_undecided,
    flatten,
    ground_depths,
    is_driven,
    sweep,
)
from recon.map.ground.level import Level
from recon.map.ground.surface import (
    GroundSettings,
    GroundSurface,
    add_floors,
    estimate_ground_surface,
    measure_camera_height,
)
from recon.map.occupancy.part import OccupancyPart, free_part
from recon.map.sessions.placed import PlacedMap

# A city of 6 by 6 km at 0.2 m; each is a byte of memory and of the file.
_MOST_CELLS: Final = 1_000_000_000
# Fraction of the ground that must lie below the height band: else parts of it become obstacles.
GROUND_RATIO: Final = 0.95
# Least distance, on a road, from the path to the edge of the grid: a footprint must fit in at the
# start.
_MARGIN_M: Final = 5.0
MadeGrid = tuple[OccupancyGrid, float | None, tuple[str, ...]]
"""A grid, the height at which something carried the camera above the ground (None = unknown, or not
at one height), and what a user of the grid should know."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GridFigures(ProductFigures):
    """The flat grid, and where the camera is above the ground."""

    resolution_m: float
    rows: int
    columns: int
    occupied_cells: int
    free_cells: int
    camera_height_m: float | None  # None = unknown, or not at one height
    T_base_camera: Float64  # (4, 4)
    level: Level

    @property
    def text(self) -> str:
        sides = (metres(cells * self.resolution_m) for cells in (self.columns, self.rows))
        return f"{' × '.join(sides)}, cells of {self.resolution_m:g} m"


@dataclass(frozen=True)
class OctomapFigures(ProductFigures):
    """The voxels that were observed, undecided ones included."""

    voxels: int


@dataclass(frozen=True)
class EsdfFigures(ProductFigures):
    """The voxels that have a signed distance, and where distances end."""

    esdf_occupied: int
    esdf_free: int
    max_distance_m: float


def grid_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the flat grid as Nav2 reads it, given the path of its YAML file.

    Those of other bands of heights lie beside it, such as ``grid_0.5-2m.yaml``.
    """
    settings, stem = context.placed.tiles.config.grid, path.with_suffix("")
    first = context.map.first
    grid, height_m, warnings = Flattening(context.placed).grid()
    write_nav2(stem, grid)
    for low_m, high_m in settings.heights_m:
        band = settings.model_copy(update={"min_height_m": low_m, "max_height_m": high_m})
        other, _, more = Flattening(context.placed, band).grid()
        write_nav2(f"{stem}_{low_m:g}-{high_m:g}m", other)
        warnings += more
    rows, columns = grid.cells.shape
    figures = GridFigures(
        resolution_m=grid.resolution_m,
        rows=rows,
        columns=columns,
        occupied_cells=int((grid.cells == OCCUPIED).sum()),
        free_cells=int((grid.cells == FREE).sum()),
        camera_height_m=height_m,
        T_base_camera=base_axes(first.T_map_world, height_m, first.mount),
        level=first.level,
    )
    return ExportResult(figures, (*first.level.warnings, *warnings), grid)


Finish = Callable[[OccupancyGrid, GroundSurface, Int32], OccupancyGrid]
"""Makes another grid of that of a tile and its margin, of the ground there, and of the voxels that
the vehicle took up."""


class Flattening:
    """Makes a grid tile by tile: the ground below the path first, then what stands on it."""

    def __init__(
        self, placed: PlacedMap, settings: GridSettings | None = None, finish: Finish | None = None
    ) -> None:
        self._tiles, self._path_m, self._trusted = placed.tiles, placed.path_m, placed.trusted
        self._config, self._resolution_m = placed.tiles.config, placed.tiles.resolution_m
        self._settings, self._finish = settings or self._config.grid, finish
        width_m, around_m = self._config.grid.vehicle_width_m, self._config.scale * _MARGIN_M
        # What is wider than all that is shown on both sides of the path did not drive there.
        self._too_wide = width_m > 2 * around_m
        self._width_m = 0.0 if self._too_wide else width_m
        # It frees cells whose centres are within half its width.
        self._margin_m = max(around_m, self._width_m / 2 + self._resolution_m)
        self._ground_depths: list[Float64] = [np.zeros(0)]

    def grid(self) -> MadeGrid:
        """Flatten the voxels of the map above its ground."""
        if self._tiles.extent[0] == self._tiles.extent[1]:
            raise MappingError("nothing was observed: there is no map to flatten")
        settings, driven = self._along_the_path()
        low, high = self._tiles.extent
        path_m = self._path_m[self._trusted, :2]
        if len(path_m):
            first = np.floor((path_m.min(axis=0) - self._margin_m) / self._resolution_m)
            last = np.ceil((path_m.max(axis=0) + self._margin_m) / self._resolution_m)
            low = (min(low[0], int(first[0])), min(low[1], int(first[1])))
            high = (max(high[0], int(last[0])), max(high[1], int(last[1])))
        shape = (high[1] - low[1], high[0] - low[0])
        if math.prod(shape) > _MOST_CELLS:
            got, expected = f"{shape[1]} x {shape[0]} cells", f"at most {_MOST_CELLS:g} cells"
            hint = "a pose or a point may be far off; or set a coarser occupancy.resolution_m"
            raise MappingError("the grid would be too large", got=got, expected=expected, hint=hint)
        cells = np.full(shape, UNKNOWN, np.int8)
        path = None
        if driven and self._width_m > 0:
            submap, step_m = self._tiles.submap_of_frame, self._resolution_m / 2
            path = DrivenPath.through(self._path_m, self._trusted, submap, step_m)
        keys = [tile.key for tile in self._tiles]
        around = dict.fromkeys((*keys, *self._crossed(self._margin_m)))
        for key in tracked(around, "tiles"):
            part = self._flat(key, settings, path)
            if part is not None:
                begin = np.array(key) * self._tiles.edge_cells
                paste(cells, low, part, begin, begin + self._tiles.edge_cells)
            self._config.memory.check("putting the grid together")
        origin_m = (low[0] * self._resolution_m, low[1] * self._resolution_m)
        grid = OccupancyGrid(cells, self._resolution_m, origin_m)
        height_m = settings.camera_height_m
        return grid, height_m if driven else None, tuple(self._warnings(height_m, driven))

    def _warnings(self, camera_height_m: float | None, driven: bool) -> Iterator[str]:
        """Yield what a user should know, such as a height band too low or thin for the cells."""
        if camera_height_m is None and not driven:
            yield "no ground was found below the path, so every cell of the grid is unknown"
        elif not driven:
            text = "the camera was not carried at one height above the ground: the grid has only "
            yield text + "what was seen, and where no robot states its base, the camera is the base"
        settings, cell_m = self._settings, self._resolution_m
        if driven and self._too_wide:
            yield (
                f"a vehicle of grid.vehicle_width_m={self._config.grid.vehicle_width_m:g} is wider "
                "than this map is around the path: the grid has only what was seen; set its width"
            )
        depths_m = np.concatenate(self._ground_depths)
        if len(depths_m):
            # What is seen as thin as can be still lies up to half a voxel off its centre.
            thick_m = max(cell_m / 2, float(np.quantile(depths_m, GROUND_RATIO)))
            if settings.min_height_m < thick_m:
                enough_m = math.ceil(20 * thick_m) / 20
                yield (
                    f"grid.min_height_m={settings.min_height_m:g} is too low to tell obstacles "
                    f"from the ground, which is {metres(thick_m)} thick in cells of {cell_m:g} m: "
                    f"parts of it are drawn as obstacles; take {enough_m:g}, or smaller cells"
                )
        if settings.max_height_m - settings.min_height_m < cell_m:
            yield (
                f"the height band of the grid, {settings.min_height_m:g} to "
                f"{settings.max_height_m:g} m, is thinner than a voxel of {cell_m:g} m: obstacles "
                "fall through; widen it, or take smaller cells"
            )

    def _flat(
        self, key: TileKey, settings: GroundSettings, path: DrivenPath | None
    ) -> OccupancyGrid | None:
        """Return the grid of a tile and its margin; None without voxels or a path nearby."""
        ground = self._ground(key, settings)
        if ground is None:
            return None
        passed: dict[int, OccupancyPart] = {}
        if path is not None:  # the space that the vehicle took up, by submap
            area = self._tiles.bounds(key).wider(self._margin_m)
            path, free = path.select(area.contains(path.points_m)), log_odds(MIN_PROBABILITY)
            for submap in np.unique(path.submap).tolist():
                points_m = path.points_m[path.submap == submap]
                keys = sweep(points_m, ground, self._width_m, self._resolution_m)
                passed[submap] = free_part(keys, free)
        voxels = self._tiles.wide_voxels(key, passed)
        self._ground_depths.append(ground_depths(voxels, ground))
        if not len(voxels):
            return None
        grid = flatten(voxels, ground, self._settings)
        if self._finish is None:
            return grid
        cells = [np.zeros((0, 3), np.int32), *(part.cells for part in passed.values())]
        return self._finish(grid, ground, np.concatenate(cells))

    def grounds(self) -> Iterator[tuple[Rectangle, GroundSurface]]:
        """Yield the tiles near the path, and the ground in each."""
        settings, _ = self._along_the_path()
        for tile in self._tiles:
            ground = self._ground(tile.key, settings)
            if ground is not None:
                yield self._tiles.bounds(tile.key), ground

    def _ground(self, key: TileKey, settings: GroundSettings) -> GroundSurface | None:
        """Return the ground of a tile and its margin; None without a path nearby."""
        reach_m = self._config.occupancy.max_range_m
        area = self._tiles.bounds(key).wider(reach_m)
        path_m = area.path(self._path_m)
        if not len(path_m):
            return None
        return estimate_ground_surface(self._ground_points(area), path_m, settings, reach_m)

    def _ground_points(self, area: Rectangle) -> PointCloud:
        """Return points in which ground is looked for: those of the cloud, and floors of voxels."""
        return add_floors(self._tiles.cloud_in(area), self._tiles.floors_in(area))

    def _crossed(self, margin_m: float) -> list[TileKey]:
        """Return the tiles that the path touches, or comes near to at one of its poses."""
        corners = [np.array(side) * margin_m for side in product((-1, 1), repeat=2)]
        path_m = self._path_m[np.isfinite(self._path_m[:, 0]), :2]
        near = np.concatenate([path_m + corner for corner in corners])
        keys = np.unique((near // self._tiles.edge_m).astype(int), axis=0)
        return [(x, y) for x, y in keys.tolist()]

    def _along_the_path(self) -> tuple[GroundSettings, bool]:
        """Return the settings with one camera height for the drive, and whether it is driven."""
        settings, known, drops = self._config.ground, [], [np.zeros(0)]
        for key in self._crossed(0.0):
            area = self._tiles.bounds(key)
            cloud, path_m = self._ground_points(area), area.path(self._path_m)
            height, along = measure_camera_height(cloud, path_m, self._config.occupancy.max_range_m)
            drops.append(along)
            if math.isfinite(height):
                known.append(height)
        if settings.camera_height_m is None and known:
            settings = settings.model_copy(update={"camera_height_m": float(np.median(known))})
        found = settings.camera_height_m or math.nan
        return settings, is_driven(np.concatenate(drops), found)


def paste(
    cells: NDArray[np.int8], low: TileKey | Int64, part: OccupancyGrid, begin: Int64, end: Int64
) -> None:
    """Copy what a grid has from ``begin`` to ``end`` (x, y) to cells that start at ``low``."""
    corner = np.rint(np.array(part.origin_m) / part.resolution_m).astype(int)
    begin, end = np.maximum(corner, begin), np.minimum(corner + part.cells.shape[::-1], end)
    if (begin >= end).any():
        return
    (x0, y0), (x1, y1) = begin - low, end - low
    (u0, v0), (u1, v1) = begin - corner, end - corner
    cells[y0:y1, x0:x1] = part.cells[v0:v1, u0:u1]


def octomap_product(context: ExportContext, path: Path) -> ExportResult:
    """Write OctoMaps ``.bt`` and ``.ot`` with the voxels that are occupied or free.

    A map may be too large.
    """
    tiles, stem, warnings = context.placed.tiles, path.with_suffix(""), []
    known = (drop_undecided(tile.voxels) for tile in tiles)
    try:
        write_octomap_tiles(stem, known, tiles.edge_cells.bit_length() - 1, tiles.resolution_m)
    except MappingError as error:
        warnings.append(f"no OctoMap: {error}")
    return ExportResult(OctomapFigures(sum(len(tile.voxels) for tile in tiles)), warnings)


def esdf_product(context: ExportContext, path: Path) -> ExportResult:
    """Write an archive of NumPy: the signed distance of the centre of each known voxel.

    What its arrays are: `docs/formats.md`. Memory holds a tile and its margin.
    """
    field, tiles = DistanceField(context.placed.tiles), context.placed.tiles
    heights = (tile.voxels.keys[:, 2] for tile in tiles)
    bottoms, tops = zip(*((z.min(), z.max() + 1) for z in heights if len(z)), strict=True)
    low = np.array([*tiles.extent[0], min(bottoms)], np.int32)
    high = np.array([*tiles.extent[1], max(tops)])
    counts = np.zeros(2, np.int64)

    def parts() -> Iterator[dict[str, NDArray[Any]]]:
        for tile in tiles:
            keys, distance_m = field.of_tile(tile.key)
            counts[:] += (distance_m < 0).sum(), (distance_m > 0).sum()
            state = np.where(distance_m < 0, OCCUPIED, FREE).astype(np.int8)
            yield {"cells": keys - low, "distance_m": distance_m, "state": state}
            tiles.config.memory.check("measuring distances")

    whole = {
        "shape": high - low,
        "origin_m": low * tiles.resolution_m,
        "resolution_m": np.float64(tiles.resolution_m),
        "max_distance_m": np.float64(field.max_distance_m),
    }
    write_npz(path, parts(), {name: np.asarray(one) for name, one in whole.items()})
    occupied, free = counts.tolist()
    return ExportResult(EsdfFigures(occupied, free, field.max_distance_m))
