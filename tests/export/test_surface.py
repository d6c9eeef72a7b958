"""Surfaces lie on what was sampled, stay open where there is no data, and face outwards."""

import os
from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
import trimesh

from recon.core.errors import MeshingError
from recon.core.open3d_raycasting import RayScene
from recon.core.values import PointCloud, RectifiedCamera, TriangleMesh
from recon.core.values.camera import project
from recon.export.mesh import poisson as poisson_file
from recon.export.mesh.grid import mesh_grid
from recon.export.mesh.poisson import MeshSettings, _fitting_depth, reconstruct_mesh
from recon.export.pair import mesh_coverage
from recon.export.pymeshlab import screened_poisson


def sphere(n: int = 3000, radius_m: float = 1.0) -> PointCloud:
    """Points evenly spread on a sphere about (3, 0, 5) (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    normals = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    return PointCloud(
        xyz=(radius_m * normals + [3, 0, 5]).astype(np.float32),
        rgb=np.where(normals[:, :1] > 0, [[200, 0, 0]], [[0, 0, 200]]).astype(np.uint8),
        normals=normals.astype(np.float32),
    )


def radii(mesh: TriangleMesh) -> np.ndarray:
    return np.linalg.norm(mesh.vertices - [3, 0, 5], axis=1)


def boundary_edges(mesh: TriangleMesh, most: int | None = None) -> int:
    """Edges of one triangle alone, or of more than ``most``."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    return int((count == 1 if most is None else count > most).sum())


@pytest.fixture(autouse=True)
def untrimmed(monkeypatch):
    monkeypatch.setattr(poisson_file, "_LEAST_SUPPORTED", 0.0)


WHOLE = MeshSettings(depth=5)


def area_m2(mesh: TriangleMesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_the_mesh_of_a_sphere_lies_on_it_is_closed_faces_out_and_has_its_colours():
    mesh = reconstruct_mesh(sphere(), WHOLE)
    # Cells of 2.2 m / 2^5 = 69 mm; the surface is placed far better than a cell.
    assert np.abs(radii(mesh) - 1).max() < 0.005
    assert boundary_edges(mesh) == 0
    outwards = mesh.vertices - np.float32([3, 0, 5])
    assert (np.einsum("ij,ij->i", mesh.normals, outwards) > 0.99).all()
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - [3, 0, 5]).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.01)
    assert (mesh.rgb[outwards[:, 0] > 0.05] == [200, 0, 0]).all()
    assert (mesh.rgb[outwards[:, 0] < -0.05] == [0, 0, 200]).all()


def test_a_hole_in_the_data_stays_a_hole():
    cloud = sphere()
    cap = cloud.xyz[:, 2] > 5.6
    mesh = reconstruct_mesh(cloud.select(~cap), MeshSettings(depth=5))
    # Point spacing is about 10 cm to the sixth neighbour: two of those beyond the rim at most.
    assert mesh.vertices[:, 2].max() < 5.6 + 0.22
    assert boundary_edges(mesh) > 30
    balloon = reconstruct_mesh(
        cloud.select(~cap), WHOLE.model_copy(update={"max_distance_spacings": None})
    )
    assert balloon.vertices[:, 2].max() > 5.6 + 0.22


def test_decimation_reaches_its_target_and_stays_on_the_sphere():
    mesh = reconstruct_mesh(sphere(), WHOLE.model_copy(update={"target_faces": 1000}))
    assert 900 <= len(mesh.faces) <= 1000
    assert np.abs(radii(mesh) - 1).max() < 0.02


def test_the_same_cloud_gives_the_same_mesh_and_nothing_else_is_touched(capfd):
    before = os.getcwd()  # noqa: PTH109 - the very thing that MeshLab can break
    first, second = (reconstruct_mesh(sphere(1000), MeshSettings(depth=4)) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)
    assert os.getcwd() == before  # noqa: PTH109
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("viewpoint_m", [None, (3.0, 0.0, 5.0)])
def test_a_cloud_without_normals_gets_them(viewpoint_m):
    cloud = PointCloud(sphere(1000).xyz)
    mesh = reconstruct_mesh(cloud, MeshSettings(depth=4), viewpoint_m)
    assert np.abs(radii(mesh) - 1).max() < 0.02
    along = np.einsum("ij,ij->i", mesh.normals, mesh.vertices - np.float32([3, 0, 5]))
    assert (np.abs(along) > 0.9).all()
    assert len(set(np.sign(along))) == 1
    if viewpoint_m is not None:
        assert (along < 0).all()  # seen from inside


@pytest.mark.parametrize(
    ("xyz", "complaint"),
    [
        (np.zeros((0, 3)), "too few points"),
        (np.eye(3), "too few points"),
        (np.full((500, 3), np.nan), "too few points"),
        (np.full((500, 3), 2.5), "one place or on one line"),
        (np.outer(np.linspace(0, 1, 500), [1.0, 2.0, 3.0]), "one place or on one line"),
        (np.vstack([sphere(500).xyz, [1e6, 0, 5]]), "a point lies far from all others"),
        (np.vstack([sphere(500).xyz, [0, 1e30, 5]]), "a point lies far from all others"),
        (np.random.default_rng(0).normal(size=(500, 3)) + 4e6, "subtract an offset"),
    ],
)
def test_clouds_without_a_surface_are_refused(xyz, complaint):
    with pytest.raises(MeshingError, match=complaint):
        reconstruct_mesh(PointCloud(xyz.astype(np.float32)), MeshSettings())


def test_the_depth_follows_the_spacing_of_the_points(monkeypatch):
    coarse, fine = sphere(1000), sphere(16000)  # spacings differ by four: two levels
    chosen = [_fitting_depth(cloud.xyz) for cloud in (coarse, fine)]
    assert chosen[1] - chosen[0] == 2
    assert _fitting_depth((100 * fine.xyz).astype(np.float32)) == chosen[1]
    monkeypatch.setattr(poisson_file, "_MAX_DEPTH", 4)
    assert _fitting_depth(fine.xyz) == 4


def test_points_of_one_plane_and_those_that_are_not_finite_give_their_surface():
    xyz = np.random.default_rng(0).uniform(0, 1, (3000, 3)).astype(np.float32)
    xyz[:, 2] = 2
    mesh = reconstruct_mesh(PointCloud(xyz), MeshSettings())
    assert area_m2(mesh) == pytest.approx(1.0, rel=0.2)  # and up to four spacings around
    # A tenth of the spacing of the points, which is 1 / sqrt(3000).
    assert np.abs(mesh.vertices[:, 2] - 2).max() < 0.002
    cloud = sphere()
    xyz, normals = cloud.xyz.copy(), cloud.normals.copy()
    xyz[::50] = np.nan
    normals[::70] = 0
    normals[1::90] = np.nan
    mesh = reconstruct_mesh(PointCloud(xyz, normals=normals), MeshSettings(depth=5))
    assert np.abs(radii(mesh) - 1).max() < 0.02


def poisson(xyz: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, ...]:
    return screened_poisson(xyz, normals, depth=5, scale=1.1, point_weight=4.0)


def test_a_poisoned_cloud_and_a_child_that_dies_are_one_line(tmp_path, monkeypatch):
    cloud = sphere(600)
    xyz = cloud.xyz.copy()
    xyz[3] = np.nan
    with pytest.raises(MeshingError, match="not finite"):
        poisson(xyz, cloud.normals)
    (tmp_path / "pymeshlab.py").write_text("import os\nos.kill(os.getpid(), 6)")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(MeshingError, match=r"failed in MeshLab.*exit code -6") as caught:
        poisson(cloud.xyz, cloud.normals)
    assert "\n" not in str(caught.value)


CAMERA = RectifiedCamera(150.0, 79.5, 49.5, 79.5, 0.2, 160, 100)
SETTINGS = MeshSettings()


def hall() -> PointCloud:
    """A board 1 m away before a wall 12 m away, a ground 1 m below, and four matches at 900 m."""
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
    return PointCloud(xyz.astype(np.float32), rgb, normals.reshape(-1, 3).astype(np.float32))


@pytest.fixture(scope="module", params=[1, 2])
def mesh(request):
    """The surface of every point, and of every second row and column."""
    n = request.param
    points = np.arange(len(hall())).reshape(CAMERA.height_px, CAMERA.width_px)
    return mesh_grid(hall().select(points[::n, ::n].ravel()), CAMERA, SETTINGS)


def test_the_view_lies_on_its_surfaces_without_sheets_and_faces_the_camera(mesh):
    y, z = mesh.vertices[:, 1:].T.astype(np.float64)
    off = np.minimum(np.minimum(np.abs(z - 1), np.abs(z - 12)), np.abs(y - 1))
    assert np.quantile(off / z, 0.98) < 0.001
    assert z.max() < 13
    # Missing are the four far points, and up to a step of the grid on either side of the board.
    assert mesh_coverage(mesh, hall()) > 0.97
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    # No triangle is of the board and of what is behind it; the ground is at y = 1.
    assert (np.ptp(corners[:, :, 2], axis=1)[corners[:, :, 1].max(axis=1) < 0.8] < 0.1).all()
    a, b, c = corners.transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), -a) > 0).all()
    assert (mesh.rgb == 90).all()
    # Flat parts have few triangles: two per pixel are 31,482.
    assert len(mesh.faces) < 8000
    assert boundary_edges(mesh, most=2) == 0


def test_a_scene_ten_times_as_large_has_the_same_triangles_one_behind_none():
    cloud, larger = hall(), replace(CAMERA, baseline_m=2.0)
    scaled = mesh_grid(replace(cloud, xyz=10 * cloud.xyz), larger, SETTINGS)
    once = mesh_grid(cloud, CAMERA, SETTINGS)
    np.testing.assert_array_equal(scaled.faces, once.faces)
    # float32 of 100 m.
    np.testing.assert_allclose(scaled.vertices, 10 * once.vertices, rtol=0, atol=1e-4)
    with pytest.raises(MeshingError, match="too few points"):
        mesh_grid(PointCloud(-cloud.xyz), CAMERA, SETTINGS)
    with pytest.raises(MeshingError, match="hardly any pixels with a depth are neighbours"):
        mesh_grid(cloud.select(np.arange(0, len(cloud), 7)[::3]), CAMERA, SETTINGS)


def test_noise_is_smoothed_within_surfaces_small_gaps_are_filled_and_larger_ones_stay():
    rng, cloud = np.random.default_rng(3), hall()
    row, column = np.mgrid[: CAMERA.height_px, : CAMERA.width_px].reshape(2, -1)
    inside = (np.abs(column - 50) < 22) & (np.abs(row - 40) < 22)
    far = np.hypot(column - 110, row - 30) > 12
    noisy_m = 1 / (1 + 0.2 / 30 * rng.normal(size=len(cloud)))
    xyz = (cloud.xyz * np.where(inside, noisy_m, 1)[:, None]).astype(np.float32)
    sigma_m = np.where(inside, 0.2 / 30, 1e-3).astype(np.float32)
    kept = np.flatnonzero(far & (rng.random(len(cloud)) > 0.2))
    noisy = replace(cloud, xyz=xyz, sigma_m=sigma_m).select(kept)
    mesh = mesh_grid(noisy, CAMERA, SETTINGS)
    u, v, _ = project(mesh.vertices, CAMERA)
    board = (np.abs(u - 50) < 16) & (np.abs(v - 40) < 16)
    # An eighth of the noise of 7 mm is left of it in windows of 80 points.
    assert np.std(mesh.vertices[board, 2]) < 0.3 * 0.2 / 30
    assert mesh_coverage(mesh, cloud.select(np.flatnonzero(far & ~inside))) > 0.9
    rays = RayScene(mesh.vertices[mesh.faces])
    seen = rays.first_hit(np.zeros(3), hall().xyz[(np.hypot(column - 110, row - 30) < 9)])
    assert (seen < 0).all()


def changes(mesh: TriangleMesh) -> np.ndarray:
    """By how much of its least the depth changes within each triangle."""
    z = mesh.vertices[mesh.faces][..., 2].astype(np.float64)
    return np.asarray(z.max(axis=1) / z.min(axis=1) - 1)


@pytest.mark.parametrize(("every", "most"), [(1, 0.1), (2, 0.21)])
def test_within_no_triangle_the_depth_changes_by_more_than_a_tenth_a_pixel(every, most):
    points = np.arange(len(hall())).reshape(CAMERA.height_px, CAMERA.width_px)
    mesh = mesh_grid(hall().select(points[::every, ::every].ravel()), CAMERA, SETTINGS)
    # The ground, which is seen from 3 to 12 m, is there all the same.
    assert 0.5 * most < changes(mesh).max() <= most + 1e-5
    ground = mesh.vertices[mesh.vertices[:, 1] > 0.99][:, 2]
    assert ground.min() < 3.1
    assert ground.max() > 11


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_that_matching_blurs_is_no_surface_however_uncertain_it_is(axis, sign):
    row, column = np.mgrid[:100, :160].astype(np.float64)
    along = sign * (column - 80 if axis == 0 else row - 50)
    # From 40 to 12 px of disparity within 9 px, of which each is off by up to 8.
    disparity = np.interp(along, [-4.5, 4.5], [12, 40])
    z = CAMERA.focal_px * CAMERA.baseline_m / disparity
    x, y = (column - CAMERA.cx_px) / CAMERA.focal_px, (row - CAMERA.cy_px) / CAMERA.focal_px
    xyz = np.stack([x * z, y * z, z], axis=-1).reshape(-1, 3).astype(np.float32)
    sigma_m = (8 * z**2 / (CAMERA.focal_px * CAMERA.baseline_m)).ravel().astype(np.float32)
    mesh = mesh_grid(PointCloud(xyz, sigma_m=sigma_m), CAMERA, SETTINGS)
    assert changes(mesh).max() <= 0.1 + 1e-5
    # Both walls are there, and nothing joins them.
    near, far = (30 / d for d in (40, 12))
    corners = mesh.vertices[mesh.faces][..., 2]
    assert {near, far} <= {round(float(z), 4) for z in mesh.vertices[:, 2]}
    between = (corners.min(axis=1) > 1.2 * near) & (corners.max(axis=1) < 0.8 * far)
    assert not between.any()
    pieces = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).body_count
    assert pieces == 2


def test_surfaces_that_touch_in_a_pixel_have_a_vertex_each():
    z = np.full((100, 160), np.nan)
    z[20:60, 20:60], z[59:90, 59:90] = 2.0, 2.0
    row, column = np.nonzero(np.isfinite(z))
    rays = np.stack([(column - 79.5) / 150, (row - 49.5) / 150, np.ones(len(row))], axis=1)
    mesh = mesh_grid(PointCloud((2 * rays).astype(np.float32)), CAMERA, SETTINGS)
    assert len(np.unique(mesh.vertices, axis=0)) <= len(mesh.vertices)
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(np.array(mesh.faces)),
    )
    assert surface.is_vertex_manifold()
    assert surface.is_edge_manifold(allow_boundary_edges=True)


def test_coverage_is_the_share_of_points_on_the_mesh():
    corners = np.array([[0, 0, 2], [1, 0, 2], [0, 1, 2]], np.float32)
    triangle = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32))
    # 0.5 % of 2 m is 1 cm.
    points = np.array([[0.2, 0.2, 2.009], [0.2, 0.2, 2.011], [-0.5, 0, 2], [0.1, 0.1, 2]])
    assert mesh_coverage(triangle, PointCloud(points.astype(np.float32))) == 0.5
