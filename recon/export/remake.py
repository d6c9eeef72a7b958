"""Products of what a run or a file has: the map of a finished run, or a cloud in one piece."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from typing import Any, Final

import numpy as np

from recon.core.errors import SettingsError
from recon.core.values import FREE, OCCUPIED, OccupancyGrid, RectifiedCamera
from recon.core.values.cloud import Frame
from recon.export.finished_map import (
    FinishedMap,
    Place,
    doubts_of,
    map_as_written,
    map_from_rays,
    place_here,
)
from recon.export.grid import export_grid
from recon.export.mesh.pieces import WHOLE, export_mesh
from recon.export.mesh.poisson import MeshSettings, reconstruct_mesh
from recon.export.mesh.view import check_coverage, mesh_coverage, reconstruct_view
from recon.export.octomap import export_octomap
from recon.export.survey import georeference
from recon.io.atomic import atomic_path
from recon.io.files import naming, reading
from recon.io.models.las import SUFFIXES as LAS
from recon.io.models.las import write_las
from recon.io.models.mesh import read_mesh, write_mesh
from recon.io.models.mlp import write_mlp
from recon.io.models.ply import read_ply, read_ply_pieces, write_ply
from recon.map.ground.axes import base_axes
from recon.map.sessions.measured import Survey
from recon.map.settings import DriveSettings
from recon.map.store.map import Map
from recon.run.finished import CLOUD, DOUBTS, MAPPED_BY, FinishedRun
from recon.run.run import Run

PRODUCTS: Final = ("cloud", "grid", "octomap", "mesh")
"""What `remake_map` makes unless told otherwise."""
ON_REQUEST: Final = LAS
"""What it makes, too."""
_OF_A_PAIR: Final = ("cloud", "mesh")
_LAYER: Final = "mesh/cloud.ply"


@dataclass(frozen=True)
class Wanted:
    """What is made of a map.

    Attributes:
        products: Any of `PRODUCTS` and `ON_REQUEST`.
        mesh: Settings of the mesh.
        formats: Formats of the mesh.
        place: Cuts the map into tiles where its rays are needed.
        survey: In whose coordinates LAS and LAZ are written; None = in those of the map.
    """

    products: Collection[str]
    mesh: MeshSettings
    formats: Sequence[str] = ("ply",)
    place: Place = place_here
    survey: Survey | None = None


def remake_map(
    source: FinishedRun, config: DriveSettings, wanted: Wanted, run: Run
) -> dict[str, Any]:
    """Make products of the map of a finished run, and write them with the record of the run.

    Args:
        source: The run that mapped the drive.
        config: Its settings; where the grid or the OctoMap is made, with changes.
        wanted: What to make.
        run: The run that makes it.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The run is damaged, lacks what a product is made from, or a file cannot be
            written.
    """
    products = wanted.products
    anew = from_rays(products)
    with run.stage("map" if anew else "read"):
        if anew:
            found = map_from_rays(source, config, wanted.place)
        else:
            voxels = "mesh" in products and wanted.mesh.free_space
            found = map_as_written(source, config, voxels=voxels)
    figures: dict[str, Any] = {"run": str(source.folder), "cloud": str(source.folder / CLOUD)}
    doubts = doubts_of(source)
    warnings = [*doubts, *found.warnings]
    if "cloud" in products:
        copy_file(source.folder / CLOUD, run.path(CLOUD))
        figures["points"] = sum(len(tile.cloud) for tile in found.tiles)
    if any(suffix in products for suffix in LAS):
        with run.stage("las"):
            figures |= _las(source, wanted, run, warnings)
    if "octomap" in products:
        with run.stage("octomap"):
            figures["voxels"], missing = export_octomap(found.tiles, run.path("map/octomap"))
        warnings += missing
    if "grid" in products:
        with run.stage("grid"):
            figures |= _grid(source, found, run, warnings)
    if "mesh" in products:
        figures |= _mesh(source, found, wanted, run, warnings)
    record: dict[str, Any] = {}
    if anew or "cloud" in products:
        T_map_world = source.T_map_world.tolist()
        figures["T_map_world"] = T_map_world
        record = {
            MAPPED_BY: source.mapped_by,
            "T_map_world": T_map_world,
            DOUBTS: doubts,
        }
    figures["warnings"] = warnings
    run.finish(figures, source=str(source.folder), inputs=found.files, record=record)
    return figures


def known_products(products: Sequence[str], *, pair: bool) -> Sequence[str]:
    """Return the requested products, or the usual ones.

    Raises:
        SettingsError: One is unknown, or not possible for a run of `recon pair`.
    """
    possible = _OF_A_PAIR if pair else (*PRODUCTS, *ON_REQUEST)
    for product in products:
        if product not in possible:
            unknown = product not in (*PRODUCTS, *ON_REQUEST)
            raise SettingsError(
                "unknown product" if unknown else "a pair has no such product",
                where="--to",
                got=product,
                expected=", ".join(possible),
                hint=None if unknown else "recon map makes it of a drive",
            )
    return list(dict.fromkeys(products)) or (_OF_A_PAIR if pair else PRODUCTS)


def from_rays(products: Collection[str]) -> bool:
    """Return whether products are made from the rays of a run, so that its voxels can be others."""
    return "grid" in products or "octomap" in products


def mesh_cloud(
    path: Path,
    camera: RectifiedCamera | None,
    settings: MeshSettings,
    run: Run,
    formats: Sequence[str] = ("ply",),
) -> dict[str, Any]:
    """Mesh a cloud file in one piece, as its camera saw it if it is that of a pair.

    Returns:
        The figures of the mesh.

    Raises:
        ReconError: The cloud cannot be read or gives no surface, or a file cannot be written.
    """
    with run.stage("read"):
        cloud = read_ply(path)
        write_ply(run.path(_LAYER), cloud)
    with run.stage("mesh"), naming(path):
        if camera is None:
            mesh, coverage = reconstruct_mesh(cloud, settings), None
        else:
            mesh = reconstruct_view(cloud, camera, settings)
            coverage = mesh_coverage(mesh, cloud)
    write_mesh(run.path(WHOLE), mesh)
    frame: Frame | None = None if camera is None else "camera"
    write_mlp(
        run.path("mesh/mesh.mlp"), {"mesh": run.path(WHOLE), "cloud": run.path(_LAYER)}, frame
    )
    _in_other_formats(run, formats, frame)
    figures = {"points": len(cloud), "vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    if coverage is None:
        return {**figures, "warnings": []}
    return {**figures, "mesh_coverage": coverage, "warnings": list(check_coverage(coverage))}


def _grid(source: FinishedRun, found: FinishedMap, run: Run, warnings: list[str]) -> dict[str, Any]:
    """Write the grid of a map; its figures."""
    written = export_grid(found.tiles, found.path_m, found.trusted, run.path("map/grid"))
    warnings += written.warnings
    return {
        "frames": len(found.path_m),
        **_cells(written.grid),
        "camera_height_m": written.camera_height_m,
        "T_base_camera": base_axes(source.T_map_world, written.camera_height_m).tolist(),
    }


def _las(source: FinishedRun, wanted: Wanted, run: Run, warnings: list[str]) -> dict[str, Any]:
    """Write the cloud as LAS or LAZ; its figures."""
    T_file_map, crs, figures = np.eye(4), None, dict[str, Any]()
    if wanted.survey is not None:
        with closing(Map.open(source.folder)) as map_:
            placed = georeference(map_, wanted.survey)
        T_file_map, crs = placed.T_survey_map, wanted.survey.crs
        figures |= placed.figures()
        warnings += placed.warnings()
    for suffix in (suffix for suffix in LAS if suffix in wanted.products):
        pieces = read_ply_pieces(source.folder / CLOUD, sigma=True)
        path = run.path(f"map/cloud.{suffix}")
        figures["points"] = write_las(path, pieces, T_file_map, crs)
    return figures


def _mesh(
    source: FinishedRun, found: FinishedMap, wanted: Wanted, run: Run, warnings: list[str]
) -> dict[str, Any]:
    """Write the mesh of a map; its figures."""
    layer = run.path(_LAYER)
    copy_file(source.folder / CLOUD, layer)
    with run.stage("mesh"):
        written = export_mesh(found.tiles, wanted.mesh, run, layer, run.threads)
    with run.stage("write"):
        _in_other_formats(run, wanted.formats, "map")
    warnings += written.warnings
    return {
        "points": written.points,
        "vertices": written.vertices,
        "faces": written.faces,
        "tiles": len(written.pieces),
    }


def _in_other_formats(run: Run, formats: Sequence[str], frame: Frame | None) -> None:
    for suffix in dict.fromkeys(formats):
        if suffix != "ply":
            write_mesh(run.path(f"mesh/mesh.{suffix}"), read_mesh(run.path(WHOLE)), frame)


def copy_file(file: Path, target: Path) -> None:
    """Copy a file, atomically.

    Raises:
        FormatError: It cannot be read.
        OutputError: The copy cannot be written.
    """
    with reading(file):
        file.stat()
    with atomic_path(target) as temporary:
        copyfile(file, temporary)


def _cells(grid: OccupancyGrid) -> dict[str, Any]:
    """Return figures of the grid."""
    rows, columns = grid.cells.shape
    return {
        "resolution_m": grid.resolution_m,
        "rows": rows,
        "columns": columns,
        "occupied_cells": int((grid.cells == OCCUPIED).sum()),
        "free_cells": int((grid.cells == FREE).sum()),
    }
