"""The files of one pair: disparity, depth, cloud, mesh, and a MeshLab project of them."""

from __future__ import annotations

from collections.abc import Sequence

from recon.core.errors import MeshingError
from recon.core.geometry.projection import depth_from_disparity
from recon.core.values import Disparity, RectifiedPair, TriangleMesh
from recon.export.mesh.poisson import MeshSettings
from recon.export.mesh.view import check_coverage, mesh_coverage, reconstruct_view
from recon.io.images.disparity_png import fitting_scale, write_disparity_png
from recon.io.images.image import write_image
from recon.io.images.pfm import write_pfm
from recon.io.models.mesh import write_mesh
from recon.io.models.mlp import Photo, write_mlp
from recon.io.models.ply import write_ply
from recon.run.directory import RunDirectory
from recon.stereo.frame import ReconstructedFrame


def mesh_frame(
    frame: ReconstructedFrame, settings: MeshSettings
) -> tuple[TriangleMesh | None, float | None, tuple[str, ...]]:
    """Mesh the cloud of a frame as its camera saw it.

    Returns:
        The surface in camera axes, None if none could be made; the share of the points that lie
        on it, in [0, 1]; warnings.
    """
    try:
        mesh = reconstruct_view(frame.cloud, frame.pair.camera, settings)
        coverage = mesh_coverage(mesh, frame.cloud)
    except MeshingError as error:
        return None, None, (f"no mesh: {error}",)
    return mesh, coverage, check_coverage(coverage)


def write_disparity_files(disparity: Disparity, run: RunDirectory) -> float:
    """Write disparity, confidence and reasons below ``disparity/``.

    Returns:
        Grey levels per pixel of disparity in ``disparity.png``.
    """
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
    write_ply(run.path("clouds/cloud.ply"), frame.cloud)
    if mesh is not None:
        for suffix in dict.fromkeys(("ply", *formats)):
            write_mesh(run.path(f"mesh/mesh.{suffix}"), mesh, "camera")
        _write_project(frame.pair, run)


def _write_project(pair: RectifiedPair, run: RunDirectory) -> None:
    path = run.path
    layers = {"mesh": path("mesh/mesh.ply"), "cloud": path("clouds/cloud.ply")}
    write_image(path("mesh/left.png"), pair.colours)
    write_mlp(path("mesh/mesh.mlp"), layers, "camera", Photo(path("mesh/left.png"), pair.camera))
