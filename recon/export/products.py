"""Everything that a run makes of its map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.core.errors import MeshingError
from recon.core.geometry.se3 import apply
from recon.core.values import OccupancyGrid, PointCloud
from recon.export.cloud import export_cloud
from recon.export.grid import export_grid
from recon.export.mesh import MeshSettings
from recon.export.mesh.pieces import WrittenMesh, export_mesh
from recon.export.octomap import export_octomap
from recon.map.drive.sequence import MappedSequence
from recon.run.directory import RunDirectory
from recon.run.progress import SILENT, Progress
from recon.run.stopwatch import Stopwatch


@dataclass(frozen=True, eq=False)
class Products:
    """What is kept in memory of a map after its files are written.

    Attributes:
        cloud: Even sample of the fused cloud; all points of a small one. Frame ``map``.
        points: Number of points in the whole fused cloud.
        removed: Number of points left out of it since they moved.
        voxels: Number of observed voxels.
        grid: The flat grid.
        camera_height_m: As in `WrittenGrid`.
        mesh: The mesh; None = not requested, or there is no surface.
        warnings: What could not be written, or is not in the grid.
    """

    cloud: PointCloud
    points: int
    removed: int
    voxels: int
    grid: OccupancyGrid
    camera_height_m: float | None
    mesh: WrittenMesh | None
    warnings: tuple[str, ...]


def write_products(
    mapped: MappedSequence,
    directory: RunDirectory,
    watch: Stopwatch,
    *,
    mesh: MeshSettings | None = None,
    threads: int | None = None,
    progress: Progress = SILENT,
) -> Products:
    """Write ``map/cloud.ply``, ``removed.ply``, ``octomap.*`` and ``grid.*``, and ``mesh/``.

    Args:
        mapped: The mapped drive.
        directory: Result folder of the run.
        watch: Times each stage.
        mesh: Settings of the mesh; None = no mesh.
        threads: Pieces of the mesh made at a time; None = one per core. Changes no result.
        progress: Told when the map and when the mesh is begun.

    Raises:
        MappingError: Nothing was observed, or the height band of the grid is empty.
        OutputError: A file cannot be written.
    """
    progress.on_stage("map")
    path_m = apply(mapped.T_map_world, mapped.trajectory.positions_m)
    trusted = np.array([record.ok for record in mapped.health])
    with watch.stage("cloud"):
        files = [directory.path(f"map/{name}.ply") for name in ("cloud", "removed")]
        cloud = export_cloud(mapped.tiles, *files)
    with watch.stage("octomap"):
        voxels, warnings = export_octomap(mapped.tiles, directory.path("map/octomap"))
    with watch.stage("grid"):
        flat = export_grid(mapped.tiles, path_m, trusted, directory.path("map/grid"))
    warnings += flat.warnings
    surface = None
    if mesh is not None:
        progress.on_stage("mesh")
        with watch.stage("mesh"):
            surface = _mesh(mapped, mesh, directory, threads, warnings)
        mapped.config.memory.check("mesh")
    return Products(
        cloud.sample,
        cloud.points,
        cloud.removed,
        voxels,
        flat.grid,
        flat.camera_height_m,
        surface,
        tuple(warnings),
    )


def _mesh(
    mapped: MappedSequence,
    settings: MeshSettings,
    directory: RunDirectory,
    threads: int | None,
    warnings: list[str],
) -> WrittenMesh | None:
    """Write the surface; failure is only a warning, since the map is usable without one."""
    # Each piece being meshed takes memory of its own.
    at_once = threads if mapped.config.memory.limit_mb is None else 1
    layer = directory.path("map/cloud.ply")
    try:
        written = export_mesh(mapped.tiles, settings, directory, layer, at_once)
    except MeshingError as error:
        warnings.append(f"no mesh: {error}")
        return None
    warnings += written.warnings
    return written
