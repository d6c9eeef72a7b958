"""The mesh of a pair follows its pixels, however far the scene and its outliers reach."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import MeshingError
from recon.core.values import PointCloud, RectifiedCamera, TriangleMesh
from recon.core.values.arrays import Float64
from recon.export.mesh.poisson import MeshSettings
from recon.export.mesh.view import mesh_coverage, reconstruct_view

CAMERA = RectifiedCamera(150.0, 79.5, 49.5, 79.5, 0.2, 160, 100)
SETTINGS = MeshSettings(point_weight=16.0)


def hall() -> tuple[PointCloud, Float64]:
    """A board 1 m away before a wall 12 m away, a ground 1 m below, and four matches at 900 m.

    Returns:
        The points with their normals, and the depth of each pixel.
    """
    row, column = np.mgrid[: CAMERA.height_px, : CAMERA.width_px].astype(np.float64)
    x = (column - CAMERA.cx_px) / CAMERA.focal_px
    y = (row - CAMERA.cy_px) / CAMERA.focal_px
    z = np.minimum(12.0, 1.0 / np.maximum(y, 1e-6))
    normals = np.where((z < 12.0)[..., None], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0])
    board = (np.abs(column - 50) < 25) & (np.abs(row - 40) < 25)
    z[board], normals[board] = 1.0, [0.0, 0.0, -1.0]
    z[5:7, 120:122] = 900.0
    xyz = np.stack([x * z, y * z, z], axis=-1).reshape(-1, 3)
    rgb = np.full((len(xyz), 3), 90, np.uint8)
    cloud = PointCloud(xyz.astype(np.float32), rgb, normals.reshape(-1, 3).astype(np.float32))
    return cloud, z


@pytest.fixture(scope="module")
def mesh() -> TriangleMesh:
    return reconstruct_view(hall()[0], CAMERA, SETTINGS)


def test_vertices_lie_on_the_surfaces(mesh: TriangleMesh) -> None:
    x, y, z = mesh.vertices.T.astype(np.float64)
    column = CAMERA.focal_px * x / z + CAMERA.cx_px
    row = CAMERA.focal_px * y / z + CAMERA.cy_px
    off = np.minimum(np.minimum(np.abs(z - 1), np.abs(z - 12)), np.abs(y - 1))
    rim = np.abs(np.maximum(np.abs(column - 50), np.abs(row - 40)) - 25) < 5
    far_points = (np.abs(column - 120.5) < 5) & (np.abs(row - 5.5) < 5)
    crease = np.abs(row - 62) < 5  # of wall and ground
    plain = ~rim & ~far_points & ~crease
    assert plain.sum() > 2000
    assert np.quantile(off[plain] / z[plain], 0.99) < 0.01
    assert z.max() < 13
    # Missing are the four far points, a seam around the board, and the rim of the image.
    assert mesh_coverage(mesh, hall()[0]) > 0.95


def test_no_sheet_joins_the_board_and_the_wall(mesh: TriangleMesh) -> None:
    z = mesh.vertices[mesh.faces][:, :, 2]
    # A disparity step of 27.5 pixels; what is left of a sheet reaches 1.4 pixels from either side.
    # In between are disparities of 4 to 28.5 pixels; the ground, which passes there, lies at y = 1.
    above = mesh.vertices[mesh.faces][:, :, 1].max(axis=1) < 0.8
    disparity = CAMERA.focal_px * CAMERA.baseline_m / z
    between = ((disparity > 4.5) & (disparity < 28)).any(axis=1) & above
    assert not between.any()


def test_faces_and_normals_point_to_the_camera_and_have_colours(mesh: TriangleMesh) -> None:
    assert mesh.normals is not None
    towards = -np.einsum("ij,ij->i", mesh.normals, mesh.vertices)
    assert np.mean(towards > 0) > 0.99
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    assert np.mean(np.einsum("ij,ij->i", np.cross(b - a, c - a), -a) > 0) > 0.99
    assert mesh.rgb is not None
    assert (mesh.rgb == 90).all()


def test_a_scene_ten_times_as_large_gives_the_same_triangles(mesh: TriangleMesh) -> None:
    cloud, _ = hall()
    larger = RectifiedCamera(150.0, 79.5, 49.5, 79.5, 2.0, 160, 100)
    scaled = reconstruct_view(
        PointCloud(cloud.xyz * 10, cloud.rgb, cloud.normals), larger, SETTINGS
    )
    # Rounding of coordinates may move a vertex over a limit.
    assert len(scaled.faces) == pytest.approx(len(mesh.faces), rel=0.01)


def test_a_cloud_behind_the_camera_is_refused() -> None:
    cloud, _ = hall()
    with pytest.raises(MeshingError, match="too few points"):
        reconstruct_view(PointCloud(-cloud.xyz), CAMERA, SETTINGS)


def test_coverage_is_the_share_of_points_on_the_mesh() -> None:
    corners = np.array([[0, 0, 2], [1, 0, 2], [0, 1, 2]], np.float32)
    triangle = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32))
    # 0.5 % of 2 m is 1 cm.
    points = np.array([[0.2, 0.2, 2.009], [0.2, 0.2, 2.011], [-0.5, 0, 2], [0.1, 0.1, 2]])
    assert mesh_coverage(triangle, PointCloud(points.astype(np.float32))) == 0.5
