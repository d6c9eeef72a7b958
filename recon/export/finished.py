"""The map of a finished run: its cloud, and its occupancy from the rays or the OctoMap it kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import apply
from recon.core.values.arrays import Bool, Float64
from recon.io.models.ply import read_ply_pieces
from recon.io.occupancy.octomap import octomap_pieces
from recon.map.settings import DriveSettings
from recon.map.store.finished import with_occupancy
from recon.map.store.map import MAP_FILE, Map
from recon.map.store.session import Session
from recon.map.tiles import Tiles
from recon.run.finished import CLOUD, OCTOMAP, FinishedRun


@dataclass(frozen=True)
class FinishedMap:
    """The map of a run, ready to be made into products again.

    Attributes:
        tiles: The map.
        path_m: float64 (N, 3), positions of the camera, map axes; empty if they were not read.
        trusted: bool (N,), which of them are to be trusted.
        files: What was read.
        warnings: What the run lacks.
    """

    tiles: Tiles
    path_m: Float64
    trusted: Bool
    files: tuple[Path, ...]
    warnings: tuple[str, ...] = ()


def map_from_rays(run: FinishedRun, config: DriveSettings) -> FinishedMap:
    """Build the occupancy of a run again from the rays in its map; the cloud is that of the run.

    Raises:
        FormatError: The run kept no rays, or is damaged.
        SettingsError: The settings need finer or longer rays than it kept.
    """
    session = Map.open(run.folder).session()
    _check_grain(session, config)
    submaps = with_occupancy(session, config)
    tiles = Tiles.of_submaps(submaps, config, run.T_map_world, session.corrections(), fuse=False)
    for cloud in read_ply_pieces(run.folder / CLOUD):
        tiles.put_cloud(cloud)
    path_m = apply(run.T_map_world, session.trajectory.positions_m)
    trusted = ~np.isin(np.arange(len(path_m)), run.untrusted)
    files = tuple(run.folder / name for name in (MAP_FILE, CLOUD))
    return FinishedMap(tiles, path_m, trusted, files)


def map_as_written(run: FinishedRun, config: DriveSettings, *, voxels: bool) -> FinishedMap:
    """Read the cloud of a run, and the voxels that its OctoMap has.

    Args:
        run: The run.
        config: Its settings.
        voxels: Whether voxels are needed; a run without an OctoMap is warned of then.

    Raises:
        FormatError: A file of the run is missing or damaged.
    """
    octomap, warnings = run.folder / OCTOMAP, []
    tiles = Tiles(config, run.T_map_world)
    for cloud in read_ply_pieces(run.folder / CLOUD):
        tiles.put_cloud(cloud)
    if voxels and octomap.is_file():
        for piece in octomap_pieces(octomap):
            tiles.put_voxels(piece)
    elif voxels:
        warnings.append(f"the run has no {OCTOMAP}: free space is not known")
    nowhere = np.zeros((0, 3))
    return FinishedMap(tiles, nowhere, np.zeros(0, bool), (run.folder / CLOUD,), tuple(warnings))


def _check_grain(session: Session, config: DriveSettings) -> None:
    """Refuse a cell size or range that the stored rays do not support."""
    if not session.ray_frames:
        raise FormatError(
            "the run kept no rays to build occupancy from",
            where=session.where,
            hint="map the drive again with --set occupancy.keep_rays=true",
        )
    if session.ray_frames != len(session):
        raise FormatError(
            "the run has different numbers of ray frames and poses",
            where=session.where,
            got=f"{session.ray_frames} and {len(session)}",
        )
    grain, wanted = session.rays(0)[1], config.occupancy
    # The 0.05 % tolerance is for rounded input, such as 0.3333 for a third.
    if wanted.resolution_m < grain.cell_m * 0.9995:
        raise SettingsError(
            "the rays kept by the run are too coarse for these voxels",
            got=f"{wanted.resolution_m:g} m",
            expected=f"at least {grain.cell_m:g} m",
            hint="map the drive again with --set occupancy.rays_per_voxel= or resolution_m=",
        )
    if wanted.max_range_m > grain.max_range_m * (1 + 1e-9):
        raise SettingsError(
            "the rays kept by the run do not reach that far",
            got=f"{wanted.max_range_m:g} m",
            expected=f"at most {grain.max_range_m:g} m",
            hint="map the drive again with --set occupancy.max_range_m=",
        )
