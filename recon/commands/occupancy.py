"""The pipeline behind `recon occupancy`: rebuild the occupancy maps of a run with other settings.

The input is the run's stored rays, trajectory and fused cloud; no image is read.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.commands.config import ReconConfig, dump_config, load_config
from recon.commands.finished_run import (
    CLOUD,
    MAPPED_BY,
    UNTRUSTED,
    FinishedRun,
    open_run,
    refuse_as_target,
)
from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import apply
from recon.core.values import FREE, OCCUPIED, OccupancyGrid, PointCloud
from recon.export.occupancy import OccupancyWriter
from recon.io.atomic import write_text
from recon.io.models.ply import read_ply_pieces
from recon.map import base_axes
from recon.map.drive_map import DriveMap, Tile
from recon.map.finished import with_occupancy
from recon.map.persistent import MAP_FILE, Map
from recon.map.session import Session
from recon.map.submap_records import Submaps
from recon.run.directory import RunDirectory
from recon.run.machine import use_threads
from recon.run.record import fingerprint, write_record
from recon.run.stopwatch import Stopwatch
from recon.run.summary import cost

_REMADE: Final = ("occupancy", "grid", "ground", "submaps")
"""Sections of the configuration that may differ from those of the run."""


@dataclass(frozen=True)
class OccupancyRequest:
    """A request to rebuild the occupancy maps of a run.

    Attributes:
        run: Folder of the run that mapped the drive.
        overrides: ``key=value`` settings; all others are those of the run.
        config: YAML file of settings, applied before the overrides; None = none.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.
    """

    run: Path
    overrides: Sequence[str] = ()
    config: Path | None = None
    out: Path | None = None
    threads: int | None = None


def run_occupancy(request: OccupancyRequest) -> dict[str, Any]:
    """Rebuild voxels and grid of a run with other settings, and write them.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The run kept no rays or is damaged, a setting needs finer or longer rays than
            it kept, or the folder cannot be written; nothing is left behind.
    """
    start = time.perf_counter()
    use_threads(request.threads)
    watch = Stopwatch()
    drive = _Drive(request)
    with RunDirectory.for_command("occupancy", request.out) as directory:
        with watch.stage("map"):
            store = drive.submaps()
        path_m = apply(drive.run.T_map_world, drive.trajectory.positions_m)
        tiles = DriveMap(store, drive.config, drive.run.T_map_world, drive.session.corrections())
        trusted = ~np.isin(np.arange(len(path_m)), drive.run.untrusted)
        writer = OccupancyWriter(tiles, drive.config, path_m, trusted, directory)
        with watch.stage("octomap"):
            for tile, cloud in drive.clouds(tiles.cloud_tile_m):
                writer.put_cloud(tile, cloud)
            voxels, warnings = writer.octomap()
        with watch.stage("grid"):
            written = writer.grid()
        warnings += written.warnings
        T_map_world = drive.run.T_map_world
        write_text(directory.path("config.yaml"), dump_config(drive.config, "map"))
        summary = {
            "run": str(request.run),
            "frames": len(drive.trajectory),
            "voxels": voxels,
            **_cells(written.grid),
            "T_map_world": T_map_world.tolist(),
            "camera_height_m": written.camera_height_m,
            "T_base_camera": base_axes(T_map_world, written.camera_height_m).tolist(),
            "warnings": warnings,
            **cost(watch, time.perf_counter() - start),
            "out": str(directory.folder),
        }
        directory.write_json("summary.json", summary)
        record = {
            "source": str(request.run),
            MAPPED_BY: drive.run.mapped_by,
            "inputs": fingerprint([request.run / n for n in (MAP_FILE, CLOUD)]),
            "T_map_world": T_map_world.tolist(),
            UNTRUSTED: list(drive.run.untrusted),
            "timings": watch.seconds,
            "warnings": warnings,
        }
        write_record(directory, "occupancy", record)
    return summary


class _Drive:
    """The stored data of a run, checked against the request."""

    def __init__(self, request: OccupancyRequest) -> None:
        self.run = open_run(request.run)
        refuse_as_target(request.run, request.out)
        self.config = _configure(self.run, request)
        self.session: Session = Map.open(self.run.folder).session()
        self.trajectory = self.session.trajectory
        _check_grain(self.session, self.config)

    def submaps(self) -> Submaps:
        """The submaps with occupancy."""
        return with_occupancy(self.session, self.config)

    def clouds(self, edge_m: float) -> Iterator[tuple[Tile, PointCloud]]:
        """The fused cloud in map axes, in parts that each lie in one tile."""
        for cloud in read_ply_pieces(self.run.folder / CLOUD):
            homes = np.floor(cloud.xyz[:, :2] / edge_m).astype(np.int64)
            tiles, where = np.unique(homes, axis=0, return_inverse=True)
            for number, tile in enumerate(tiles.tolist()):
                yield (tile[0], tile[1]), cloud.select(where.ravel() == number)


def _configure(run: FinishedRun, request: OccupancyRequest) -> ReconConfig:
    """The settings of the run with the requested changes."""
    known = run.config.model_dump(mode="json")
    config = load_config(request.config, request.overrides, defaults=known)
    changed = config.model_dump(mode="json")
    other = [name for name in known if name not in _REMADE and known[name] != changed[name]]
    if other:
        raise SettingsError(
            "this setting has no effect here: the drive is not mapped again",
            got=other[0],
            expected=f"settings of {', '.join(_REMADE)}",
            hint="recon map takes it",
        )
    return config


def _check_grain(session: Session, config: ReconConfig) -> None:
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


def _cells(grid: OccupancyGrid) -> dict[str, Any]:
    """Figures of the grid."""
    rows, columns = grid.cells.shape
    return {
        "resolution_m": grid.resolution_m,
        "rows": rows,
        "columns": columns,
        "occupied_cells": int((grid.cells == OCCUPIED).sum()),
        "free_cells": int((grid.cells == FREE).sum()),
    }
