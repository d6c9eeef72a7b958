"""The occupancy of a map as OctoMap files."""

from __future__ import annotations

from pathlib import Path

from recon.core.errors import MappingError
from recon.export.product import Made, Order
from recon.io.occupancy.octomap import write_octomap_tiles
from recon.map.ground.grid import drop_undecided
from recon.map.tiles import Tiles


def octomap_product(order: Order) -> Made:
    """Write ``map/octomap.bt`` and ``.ot``."""
    voxels, warnings = export_octomap(order.placed.tiles, order.run.path("map/octomap"))
    return Made({"voxels": voxels}, warnings)


def export_octomap(tiles: Tiles, stem: Path) -> tuple[int, list[str]]:
    """Write ``stem.bt`` and ``stem.ot`` with the voxels that are occupied or free.

    Returns:
        The number of observed voxels, undecided ones included, and warnings: a map may be too large
        for an OctoMap.
    """
    known = (drop_undecided(tile.voxels, tiles.config.grid) for tile in tiles)
    warnings = []
    try:
        write_octomap_tiles(stem, known, tiles.edge_cells.bit_length() - 1, tiles.resolution_m)
    except MappingError as error:
        warnings.append(f"no OctoMap: {error}")
    return sum(len(tile.voxels) for tile in tiles), warnings
