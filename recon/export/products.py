"""Everything that a run makes of its map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from recon.core.errors import MeshingError
from recon.core.values import OccupancyGrid, PointCloud
from recon.core.values.arrays import Bool, Float64
from recon.export.cloud import export_cloud
from recon.export.grid import export_grid
from recon.export.mesh.pieces import WrittenMesh, export_mesh
from recon.export.mesh.poisson import MeshSettings
from recon.export.octomap import export_octomap
from recon.map.tiles import Tiles
from recon.run.run import Run


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


class Placed(Protocol):
    """What products are made of: a mapped drive, or the drives of a finished map."""

    @property
    def tiles(self) -> Tiles:
        """The map."""
        ...

    @property
    def path_m(self) -> Float64:
        """float64 (N, 3), positions of the camera, map axes; a row of NaN between two drives."""
        ...

    @property
    def trusted(self) -> Bool:
        """bool (N,), which of them are to be trusted."""
        ...


def write_products(mapped: Placed, run: Run, mesh: MeshSettings | None = None) -> Products:
    """Write ``map/cloud.ply``, ``removed.ply``, ``octomap.*`` and ``grid.*``, and ``mesh/``.

    Args:
        mapped: The mapped drives.
        run: The run, whose folder they go to.
        mesh: Settings of the mesh; None = no mesh.

    Raises:
        MappingError: Nothing was observed, or the height band of the grid is empty.
        OutputError: A file cannot be written.
    """
    run.progress.on_stage("map")
    tiles = mapped.tiles
    with run.stage("cloud"):
        files = [run.path(f"map/{name}.ply") for name in ("cloud", "removed")]
        cloud = export_cloud(tiles, *files)
    with run.stage("octomap"):
        voxels, warnings = export_octomap(tiles, run.path("map/octomap"))
    with run.stage("grid"):
        flat = export_grid(tiles, mapped.path_m, mapped.trusted, run.path("map/grid"))
    warnings += [*cloud.warnings, *flat.warnings]
    surface = None
    if mesh is not None:
        run.progress.on_stage("mesh")
        with run.stage("mesh"):
            surface = _mesh(tiles, mesh, run, warnings)
        tiles.config.memory.check("mesh")
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
    tiles: Tiles, settings: MeshSettings, run: Run, warnings: list[str]
) -> WrittenMesh | None:
    """Write the surface; failure is only a warning, since the map is usable without one."""
    # Each piece being meshed takes memory of its own.
    at_once = run.threads if tiles.config.memory.limit_mb is None else 1
    try:
        written = export_mesh(tiles, settings, run, run.path("map/cloud.ply"), at_once)
    except MeshingError as error:
        warnings.append(f"no mesh: {error}")
        return None
    warnings += written.warnings
    return written
