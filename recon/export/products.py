"""Everything that a run makes of its map."""

from __future__ import annotations

from dataclasses import dataclass

from recon.core.errors import MeshingError
from recon.core.values import OccupancyGrid, PointCloud
from recon.export.files import write_map
from recon.export.mesh import MeshSettings
from recon.export.mesh.drive_mesh import WrittenMesh, store_map, write_drive_mesh
from recon.map.sequence import MappedSequence
from recon.run.directory import RunDirectory
from recon.run.progress import SILENT, Progress
from recon.run.stopwatch import Stopwatch


@dataclass(frozen=True, eq=False)
class Products:
    """What is kept in memory of a map after its files are written.

    Attributes:
        cloud: Even sample of the fused cloud; all points of a small one. Frame ``map``.
        points: Number of points in the whole fused cloud.
        voxels: Number of observed voxels.
        grid: The flat grid.
        camera_height_m: As in `WrittenGrid`.
        mesh: The mesh; None = not requested, or there is no surface.
        warnings: What could not be written, or is not in the grid.
    """

    cloud: PointCloud
    points: int
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
    """Write ``map/cloud.ply``, ``map/octomap.*``, ``map/grid.*`` and ``mesh/``.

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
    made = write_map(mapped, directory, watch)
    warnings = list(made.warnings)
    surface = None
    if mesh is not None:
        progress.on_stage("mesh")
        with watch.stage("mesh"):
            surface = _mesh(mapped, mesh, directory, threads, warnings)
        mapped.config.memory.check("mesh")
    return Products(
        made.cloud,
        made.points,
        made.voxels,
        made.grid,
        made.camera_height_m,
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
    store = store_map(mapped, settings, directory.state("mesh"))
    # Each tile being meshed takes memory of its own.
    at_once = threads if mapped.config.memory.limit_mb is None else 1
    layer = directory.path("map/cloud.ply")
    try:
        written = write_drive_mesh(store, settings, directory, layer, at_once)
    except MeshingError as error:
        warnings.append(f"no mesh: {error}")
        return None
    warnings += written.warnings
    return written
