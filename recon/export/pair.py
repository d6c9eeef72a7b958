"""What is made of one pair, or of any cloud file: images, cloud, mesh, a MeshLab project."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from shutil import copyfile
from typing import Any

from recon.core.errors import MeshingError
from recon.core.values import Disparity, RectifiedCamera, TriangleMesh
from recon.core.values.camera import depth_from_disparity
from recon.core.values.cloud import Frame
from recon.export.mesh.pieces import LAYER, WHOLE, in_other_formats
from recon.export.mesh.poisson import MeshSettings, reconstruct_mesh
from recon.export.mesh.view import check_coverage, mesh_coverage, reconstruct_view
from recon.io.atomic import atomic_path
from recon.io.files import naming, reading
from recon.io.images.disparity import fitting_scale, write_disparity_png, write_pfm
from recon.io.images.image import write_image
from recon.io.models.mesh import write_mesh
from recon.io.models.mlp import Photo, write_mlp
from recon.io.models.ply import read_ply, write_ply
from recon.run.directory import RunDirectory
from recon.run.finished import PAIR_CLOUD, camera_of_pair
from recon.run.run import Run
from recon.stereo.frame import ReconstructedFrame


def mesh_frame(
    frame: ReconstructedFrame, settings: MeshSettings
) -> tuple[TriangleMesh | None, float | None, tuple[str, ...]]:
    """Mesh the cloud of a frame as its camera saw it.

    Returns:
        The surface in camera axes, or None; the share of the points that lie on it; warnings.
    """
    try:
        mesh = reconstruct_view(frame.cloud, frame.pair.camera, settings)
        coverage = mesh_coverage(mesh, frame.cloud)
    except MeshingError as error:
        return None, None, (f"no mesh: {error}",)
    return mesh, coverage, check_coverage(coverage)


def write_disparity_files(disparity: Disparity, run: RunDirectory) -> float:
    """Write disparity, confidence, reasons; return grey levels per pixel in ``disparity.png``."""
    path, scale = run.path, fitting_scale(disparity.values)
    write_pfm(path("disparity/disparity.pfm"), disparity.values)
    write_disparity_png(path("disparity/disparity.png"), disparity.values, scale=scale)
    write_pfm(path("disparity/confidence.pfm"), disparity.confidence)
    write_image(path("disparity/reason.png"), disparity.reason)
    return scale


def write_cloud_files(
    frame: ReconstructedFrame,
    mesh: TriangleMesh | None,
    formats: Sequence[str],
    run: RunDirectory,
) -> None:
    """Write depth, cloud and mesh (PLY and ``formats``), and a project with the left image."""
    depth_m = depth_from_disparity(frame.disparity.values, frame.pair.camera)
    write_pfm(run.path("disparity/depth.pfm"), depth_m)
    write_ply(run.path(PAIR_CLOUD), frame.cloud)
    if mesh is not None:
        for suffix in dict.fromkeys(("ply", *formats)):
            write_mesh(run.path(f"mesh/mesh.{suffix}"), mesh, "camera")
        layers, left = {"mesh": run.path(WHOLE), "cloud": run.path(PAIR_CLOUD)}, "mesh/left.png"
        write_image(run.path(left), frame.pair.colours)
        photo = Photo(run.path(left), frame.pair.camera)
        write_mlp(run.path("mesh/mesh.mlp"), layers, "camera", photo)


def mesh_cloud(
    path: Path,
    camera: RectifiedCamera | None,
    settings: MeshSettings,
    run: Run,
    formats: Sequence[str] = ("ply",),
) -> dict[str, Any]:
    """Mesh a cloud file in one piece, as its camera saw it if it is that of a pair; its figures."""
    with run.stage("read"):
        cloud = read_ply(path)
        write_ply(run.path(LAYER), cloud)
    with run.stage("mesh"), naming(path):
        if camera is None:
            mesh, coverage = reconstruct_mesh(cloud, settings), None
        else:
            mesh = reconstruct_view(cloud, camera, settings)
            coverage = mesh_coverage(mesh, cloud)
    write_mesh(run.path(WHOLE), mesh)
    frame: Frame | None = None if camera is None else "camera"
    write_mlp(run.path("mesh/mesh.mlp"), {"mesh": run.path(WHOLE), "cloud": run.path(LAYER)}, frame)
    in_other_formats(run, formats, frame)
    figures = {"points": len(cloud), "vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    if coverage is None:
        return {**figures, "warnings": []}
    return {**figures, "mesh_coverage": coverage, "warnings": list(check_coverage(coverage))}


def export_pair(
    source: Path, settings: MeshSettings, products: Sequence[str], run: Run, formats: Sequence[str]
) -> dict[str, Any]:
    """Write cloud and mesh of a run of `recon pair`, or one of them; the figures of the summary."""
    cloud, camera = source / PAIR_CLOUD, camera_of_pair(source)
    figures: dict[str, Any] = {"run": str(source), "warnings": []}
    if "cloud" in products:
        with reading(cloud):
            cloud.stat()
        with atomic_path(run.path(PAIR_CLOUD)) as temporary:
            copyfile(cloud, temporary)
    if "mesh" in products:
        figures |= mesh_cloud(cloud, camera, settings, run, formats)
    return finish_cloud_run(source, cloud, run, figures)


def finish_cloud_run(
    source: Path, cloud: Path, run: Run, figures: dict[str, Any]
) -> dict[str, Any]:
    """Complete a run that made something of a cloud file."""
    figures = {"cloud": str(cloud), **figures}
    run.finish(figures, source=str(source), inputs=[cloud])
    return figures
