"""What is made of one pair, or of any cloud file: images, cloud, mesh, a MeshLab project."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError, MeshingError
from recon.core.open3d_raycasting import RayScene
from recon.core.values import Disparity, PointCloud, RectifiedCamera, Texture, TriangleMesh
from recon.core.values.arrays import UInt8
from recon.core.values.camera import depth_from_disparity, project
from recon.core.values.cloud import Frame
from recon.core.values.image import in_colour
from recon.export.mesh.grid import mesh_grid
from recon.export.mesh.pieces import WHOLE, MeshFigures
from recon.export.mesh.poisson import MeshSettings, reconstruct_mesh
from recon.io.images.disparity import fitting_scale, write_disparity_png, write_pfm
from recon.io.images.image import read_image, write_image
from recon.io.models.mesh import Photo, write_mesh, write_mlp
from recon.io.models.ply import write_ply
from recon.stereo.frame import ReconstructedFrame

PAIR_CLOUD: Final = "clouds/cloud.ply"
_PHOTO: Final = "left.png"  # the left image, beside the mesh
_POINT_WEIGHT: Final = 16.0  # of Poisson's surface: the points of a pair are not means of many


def mesh_frame(
    frame: ReconstructedFrame, settings: MeshSettings
) -> tuple[TriangleMesh | None, float | None, tuple[str, ...]]:
    """Mesh a frame: surface in camera axes or None, fraction of measured points on it, warnings."""
    try:
        mesh = _surface(frame.cloud, frame.pair.camera, settings, frame.pair.colours)
        coverage = _coverage(mesh, frame.cloud, settings)
    except MeshingError as error:
        return None, None, (f"no mesh: {error}",)
    return mesh, coverage, check_coverage(coverage)


def _surface(
    cloud: PointCloud, camera: RectifiedCamera, settings: MeshSettings, image: UInt8 | None
) -> TriangleMesh:
    """Mesh the cloud of a pair, and colour it by the left image if that is known."""
    if settings.surface == "grid":
        mesh = mesh_grid(cloud, camera, settings)
    else:
        mesh = reconstruct_mesh(cloud, settings, (0.0, 0.0, 0.0), point_weight=_POINT_WEIGHT)
    if image is None:
        return mesh
    u, v, _ = project(mesh.vertices, camera)
    # The middle of the first pixel is half a pixel from the corner.
    uv = np.stack([(u + 0.5) / camera.width_px, (v + 0.5) / camera.height_px], axis=1)
    inside = np.clip(np.nan_to_num(uv), 0, 1).astype(np.float32)
    return replace(mesh, texture=Texture(image, inside, _PHOTO))


def _coverage(mesh: TriangleMesh, cloud: PointCloud, settings: MeshSettings) -> float:
    """Return the fraction of the measured points, if there are any, on the front of a mesh."""
    measured = cloud.only_measured()
    if settings.pair_solid_m is not None:
        # Of a closed body, vertices in front come first.
        front = (mesh.faces < len(mesh.vertices) // 2).all(axis=1)
        mesh = replace(mesh, faces=mesh.faces[front])
    return mesh_coverage(mesh, measured if len(measured) else cloud)


def write_disparity_files(
    disparity: Disparity, folder: Path, camera: RectifiedCamera | None = None
) -> float | None:
    """Write disparity, confidence, reasons; return grey levels per pixel in ``disparity.png``.

    What was inferred is in files of its own, if there is any. With a camera, depth is written, too.
    A PNG holds no negative disparities: then there is none, and None is returned.
    """
    folder, measured = folder / "disparity", disparity.only_measured()
    kinds = [("disparity", "", measured)]
    if disparity.inferred.any():
        kinds.append(("inferred", "inferred_", disparity.only_inferred()))
    for name, prefix, kind in kinds:
        write_pfm(folder / f"{name}.pfm", kind.values)
        write_pfm(folder / f"{prefix}confidence.pfm", kind.confidence)
        if camera is not None:
            write_pfm(folder / f"{prefix}depth.pfm", depth_from_disparity(kind.values, camera))
    write_image(folder / "reason.png", disparity.reason)
    if np.nanmin(measured.values, initial=0.0) < 0.0:
        return None
    scale = fitting_scale(measured.values)
    write_disparity_png(folder / "disparity.png", measured.values, scale=scale)
    return scale


def write_cloud_files(
    frame: ReconstructedFrame, mesh: TriangleMesh | None, formats: Sequence[str], folder: Path
) -> None:
    """Write cloud and mesh (PLY and ``formats``), and a project with the left image."""
    write_ply(folder / PAIR_CLOUD, frame.cloud)
    if mesh is not None:
        write_surface(mesh, frame.pair.camera, folder / PAIR_CLOUD, formats, folder / WHOLE)


def write_surface(
    mesh: TriangleMesh,
    camera: RectifiedCamera | None,
    cloud: Path,
    formats: Sequence[str],
    path: Path,
) -> None:
    """Write a mesh, with its texture if it is that of a camera, and a project with both."""
    frame: Frame | None = None if camera is None else "camera"
    for suffix in dict.fromkeys(("ply", *formats)):
        write_mesh(path.with_suffix(f".{suffix}"), mesh, frame)
    photos = []
    if camera is not None and mesh.texture is not None:
        photos = [Photo(path.with_name(mesh.texture.name), camera)]
    write_mlp(path.with_suffix(".mlp"), {"mesh": path, "cloud": cloud}, frame, photos)


def mesh_cloud(
    cloud: PointCloud, camera: RectifiedCamera | None, settings: MeshSettings, run: Path
) -> tuple[TriangleMesh, MeshFigures]:
    """Mesh a cloud in one piece, as its camera saw it if it is that of a pair; with figures.

    ``run`` is the folder of the pair, in which its left image may be.
    """
    if camera is None and settings.pair_solid_m is not None:
        what, hint = "only the surface of a pair is closed behind", "name the folder of its run"
        raise MeshingError(what, got=f"mesh.pair_solid_m={settings.pair_solid_m:g}", hint=hint)
    if camera is None:
        mesh, coverage = reconstruct_mesh(cloud, settings), None
    else:
        photo, path = None, run / "mesh" / _PHOTO
        if path.is_file():  # else the run of the pair made no mesh
            photo, size = read_image(path), (camera.height_px, camera.width_px)
            if photo.shape[:2] != size:
                what, expected = "the image is not that of the run", f"{size[1]}x{size[0]} pixels"
                got = f"{photo.shape[1]}x{photo.shape[0]}"
                raise FormatError(what, where=path, got=got, expected=expected)
            photo = in_colour(photo)
        mesh = _surface(cloud, camera, settings, photo)
        coverage = _coverage(mesh, cloud, settings)
    return mesh, MeshFigures(
        points=len(cloud),
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        mesh_coverage=coverage,
    )


# A point is covered if the mesh is no farther from it than this fraction of its depth.
COVERED_WITHIN: Final = 0.005
LEAST_COVERAGE: Final = 0.8  # fraction of the points of a pair that its mesh should cover
_COVERAGE_SAMPLES: Final = 100_000


def mesh_coverage(mesh: TriangleMesh, cloud: PointCloud) -> float:
    """Return the fraction of points, of at most 100,000, that the mesh of a pair covers."""
    xyz = cloud.xyz[:: math.ceil(len(cloud) / _COVERAGE_SAMPLES)]
    distance_m = RayScene(mesh.vertices[mesh.faces]).distance(xyz)
    return float(np.mean(distance_m <= COVERED_WITHIN * xyz[:, 2]))


def check_coverage(coverage: float) -> tuple[str, ...]:
    """Return a warning if the mesh of a pair leaves out much of its cloud."""
    if coverage >= LEAST_COVERAGE:
        return ()
    tolerance = f"points within {100 * COVERED_WITHIN:g} % of their depth"
    advice = "lower mesh.min_component_faces, or use the cloud"
    return (f"the mesh covers {100 * coverage:.2g} % of the cloud ({tolerance}); {advice}",)
