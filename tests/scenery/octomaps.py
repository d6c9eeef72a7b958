"""OctoMaps of maps that are small enough to be one tile."""

from pathlib import Path

from recon.core.values import OccupancyVoxels
from recon.io.models.octomap import write_octomap_tiles


def write_octomap(path: Path, voxels: OccupancyVoxels) -> tuple[Path, Path]:
    """Write ``path.bt`` and ``path.ot``."""
    return write_octomap_tiles(path, [voxels], 8, voxels.resolution_m)
