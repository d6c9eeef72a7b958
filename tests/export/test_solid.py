"""The surface of a pair as a closed body: watertight in the program that reads it."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from recon.commands.config import PAIR_DEFAULTS, load_config
from recon.commands.pair import run_pair
from recon.core.errors import MeshingError, SettingsError
from recon.core.values import PointCloud, RectifiedCamera, TriangleMesh
from recon.export.mesh.grid import closed_behind, mesh_grid
from recon.export.mesh.poisson import MeshSettings
from recon.io.models.mesh import write_mesh
from recon.sources.one_pair import read_pair_input
from tests.scenery.middlebury import write_scene

CAMERA = RectifiedCamera(150.0, 79.5, 49.5, 79.5, 0.2, 160, 100)
THICK_M = 0.05


def solid(depth_m: np.ndarray, thick_m: float = THICK_M, least: int = 1) -> TriangleMesh:
    """The body of a map of depths (H, W), NaN = none."""
    row, column = np.nonzero(np.isfinite(depth_m))
    x, y = (column - CAMERA.cx_px) / CAMERA.focal_px, (row - CAMERA.cy_px) / CAMERA.focal_px
    xyz = np.stack([x, y, np.ones(len(x))], axis=1) * depth_m[row, column, None]
    rgb = np.full((len(xyz), 3), 90, np.uint8)
    settings = MeshSettings(pair_solid_m=thick_m, min_component_faces=least)
    return mesh_grid(PointCloud(xyz.astype(np.float32), rgb), CAMERA, settings)


def read_back(mesh: TriangleMesh, folder: Path) -> trimesh.Trimesh:
    """What another program reads: it joins vertices that are in one place."""
    write_mesh(folder / "mesh.ply", mesh, "camera")
    return trimesh.load(folder / "mesh.ply", force="mesh")


def wall(depth_m: float = 2.0) -> np.ndarray:
    return np.full((CAMERA.height_px, CAMERA.width_px), depth_m)


def with_a_hole() -> np.ndarray:
    depth = wall()
    depth[30:70, 60:100] = np.nan
    return depth


def in_pieces() -> np.ndarray:
    """A board before a wall, both slanted, and a strip apart from them."""
    row, column = np.mgrid[:100, :160]
    depth = 3.0 + 0.005 * column
    board = (np.abs(column - 60) < 25) & (np.abs(row - 40) < 20)
    depth[board] = (1.0 + 0.002 * row)[board]
    depth[:, 120:130] = np.nan
    return depth


def tiny() -> np.ndarray:
    depth = np.full((100, 160), np.nan)
    depth[40:48, 70:78] = 2.0
    return depth


@pytest.mark.parametrize(
    ("depth", "bodies"),
    [(wall, 1), (with_a_hole, 1), (in_pieces, 3), (tiny, 1)],
)
def test_a_body_is_watertight_and_its_pieces_stay_apart(depth, bodies, tmp_path):
    body = read_back(solid(depth()), tmp_path)
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.is_volume
    assert body.body_count == bodies


@pytest.mark.parametrize("fans", [2, 3])
def test_surfaces_that_touch_in_a_point_become_bodies_that_do_not(fans, tmp_path):
    turn = np.arange(2 * fans) * np.pi / fans
    rim = np.stack([np.cos(turn), np.sin(turn), 2 + 0.3 * np.cos(3 * turn)], axis=1)
    faces = [[0, 2 * k + 1, 2 * k + 2] for k in range(fans)]  # clockwise: towards the camera
    corners = np.vstack([[0.0, 0.0, 2.0], rim])[np.array(faces)[:, [0, 2, 1]]]
    mesh = TriangleMesh(
        corners.reshape(-1, 3).astype(np.float32),
        np.arange(3 * fans, dtype=np.int32).reshape(-1, 3),
    )
    body = read_back(closed_behind(mesh, THICK_M), tmp_path)
    assert body.is_volume
    assert body.body_count == fans
    assert len(body.vertices) == 6 * fans


def test_a_body_has_the_stated_thickness_and_the_volume_that_follows(tmp_path):
    front, body = solid(wall(), 1e-4), solid(wall())
    n = len(body.vertices) // 2
    np.testing.assert_allclose(body.vertices[:n, 2], 2.0, atol=1e-4)
    np.testing.assert_allclose(body.vertices[n:, 2], 2.0 + THICK_M, atol=1e-4)
    # Each vertex behind is on the ray of the one before it.
    rays = body.vertices[:, :2] / body.vertices[:, 2:]
    np.testing.assert_allclose(rays[:n], rays[n:], atol=1e-6)
    assert (body.rgb == 90).all()
    # A truncated pyramid of 159 by 99 pixels, between both depths.
    volume = 159 * 99 / 150**2 * ((2.0 + THICK_M) ** 3 - 2.0**3) / 3
    assert read_back(body, tmp_path).volume == pytest.approx(volume, rel=1e-3)
    assert read_back(front, tmp_path).volume == pytest.approx(volume * 1e-4 / THICK_M, rel=0.05)
    # Outwards: towards the camera before, away from it behind, in the middle of both.
    middle = np.abs(rays).max(axis=1) < 0.2
    assert (body.normals[:n][middle[:n], 2] < -0.99).all()
    assert (body.normals[n:][middle[n:], 2] > 0.99).all()


def test_a_thick_body_of_steps_has_no_part_in_another():
    body = solid(in_pieces(), 5.0)
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(body.vertices.copy(), body.faces.astype(np.uint32))
    # What a ray enters it leaves, and it meets one body at most: no or two faces.
    away = np.random.default_rng(0).uniform([-0.5, -0.3], [0.5, 0.3], (3000, 2))
    lines = np.column_stack([np.zeros((3000, 3)), away, np.ones(3000)]).astype(np.float32)
    assert set(rays.count_intersections(lines).numpy().tolist()) == {0, 2}


def test_a_surface_stays_open_unless_a_thickness_is_given():
    row, column = np.mgrid[:100, :160]
    xyz = np.stack([(column - 79.5) / 75, (row - 49.5) / 75, np.full(row.shape, 2.0)], axis=-1)
    mesh = mesh_grid(PointCloud(xyz.reshape(-1, 3).astype(np.float32)), CAMERA, MeshSettings())
    assert not trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight


@pytest.mark.parametrize("other", [{"surface": "poisson"}, {"target_faces": 1000}])
def test_what_cannot_be_closed_is_said_before_anything_is_made(other):
    with pytest.raises(SettingsError, match="pair_solid_m"):
        MeshSettings.parse({"pair_solid_m": 0.1, **other})


def test_a_body_thinner_than_its_coordinates_are_exact_is_refused():
    with pytest.raises(MeshingError, match=r"too thin.*at least 2e-05 m.*raise mesh.pair_solid_m"):
        solid(wall(), 1e-6)


def test_a_pair_becomes_a_body_by_a_setting(tmp_path):
    scene, out = tmp_path / "scene", tmp_path / "run"
    write_scene(scene)
    given = read_pair_input(*(scene / name for name in ("im0.png", "im1.png", "calib.txt")))
    config = load_config(None, ["mesh.pair_solid_m=0.01"], PAIR_DEFAULTS)
    made = run_pair(given, config, out=out, formats=("obj", "glb"))
    assert made.summary.to_json()["mesh_coverage"] > 0.8
    for name in ("mesh.ply", "mesh.obj", "mesh.glb"):
        body = trimesh.load(out / "mesh" / name, force="mesh")
        body.merge_vertices(merge_tex=True, merge_norm=True)
        assert body.is_watertight, name
