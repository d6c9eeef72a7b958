"""A map as a folder for any web server: a page that asks for nothing elsewhere, and 3D Tiles."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import MappingError
from recon.core.values import ATTRIBUTES, OCCUPIED, UNKNOWN, OccupancyGrid, PointCloud
from recon.core.values.arrays import UInt8
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext, ExportResult, PointFigures
from recon.io.atomic import write_bytes, write_text
from recon.io.models.tiles3d import write_tiles3d
from recon.map.tiles import Tiles

_PAGE: Final = Path(__file__).with_name("web.html")
_CELLS: Final[UInt8] = np.array([(70, 132, 110), (240, 104, 66)], np.uint8)  # free, occupied
_MOST_POSES: Final = 20_000  # of the paths that are drawn


def web_product(context: ExportContext, folder: Path) -> ExportResult:
    """Write a folder with ``index.html``, and what it shows: ``map.json``, ``cloud``, ``grid``.

    All is in map axes; the page has the way to those of a survey. Of drives it has the names, not
    where they are.
    """
    tiles, flattening = context.placed.tiles, Flattening(context.placed)
    low, high = (np.array(one) // tiles.edge_cells for one in tiles.extent)
    side_m = tiles.edge_m * (1 << int((high - low).max()).bit_length())
    corner_m = np.array([*(low * tiles.edge_m), -side_m / 2])
    write = partial(write_tiles3d, low_m=corner_m, side_m=side_m, square_m=tiles.edge_m)
    voxel_m, path_m = tiles.config.fusion.voxel_m, context.placed.path_m
    points = write(folder / "cloud", (tile.cloud for tile in tiles), spacing_m=voxel_m)
    if not points:
        raise MappingError("the map is empty: there is nothing to show")
    grid, _, warnings = flattening.grid()
    cells = write(folder / "grid", _draped(tiles, grid, flattening), spacing_m=grid.resolution_m)
    ends = np.flatnonzero(np.diff(context.placed.trusted.astype(np.int8), prepend=0, append=0))
    step = 1 + len(path_m) // _MOST_POSES
    about = {
        # Of files, the date may be that of a copy.
        "drives": [
            [Path(one.info.source).name, one.date.text if one.date.known_from != "file" else ""]
            for one in context.map.linked
        ],
        "points": points,
        "spacing_m": voxel_m,
        "grid": cells > 0,
        "T_survey_map": context.T_survey_map.tolist(),
        "axes": "xyz" if context.survey is None else "ENH",
        "crs": context.crs or "",
        "attributes": {one.name: [one.view, one.unit] for one in ATTRIBUTES if one.scale},
        "paths": [path_m[first:end:step].tolist() for first, end in ends.reshape(-1, 2).tolist()],
    }
    write_text(folder / "map.json", json.dumps(about, allow_nan=False))
    write_bytes(folder / "index.html", _PAGE.read_bytes())
    return ExportResult(PointFigures(points), warnings)


def _draped(tiles: Tiles, grid: OccupancyGrid, flattening: Flattening) -> Iterator[PointCloud]:
    """Yield the known cells of each tile as points on the ground, where that is known."""
    first = np.rint(np.array(grid.origin_m) / grid.resolution_m).astype(int)
    for bounds, ground in flattening.grounds():
        begin = np.rint(np.array(bounds.low) / grid.resolution_m).astype(int) - first
        (u0, v0), (u1, v1) = np.maximum([begin, begin + tiles.edge_cells], 0)
        row, column = np.nonzero(grid.cells[v0:v1, u0:u1] != UNKNOWN)
        row, column = row + v0, column + u0
        xy_m = (np.stack([column, row], axis=1) + first + 0.5) * grid.resolution_m
        height_m = ground.height_at(xy_m)
        known, rgb = np.isfinite(height_m), _CELLS[1 * (grid.cells[row, column] == OCCUPIED)]
        xyz = np.column_stack([xy_m, height_m]).astype(np.float32)
        yield PointCloud(xyz[known], rgb[known], frame="map")
