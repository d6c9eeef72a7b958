"""Which points are shown of many, which one a click hits, and how a grid lies on the ground."""

import numpy as np
import pytest

from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, PointCloud
from recon.map.ground.surface import GroundSurface
from recon.report.scene import Points
from recon.view import server
from recon.view.server import cut, halvings, pick


def spread(x_m: float, count: int = 1000) -> Points:
    """Points in a cube of a metre."""
    xyz = np.random.default_rng(0).random((count, 3), np.float32) + np.float32((x_m, 0, 0))
    return Points(f"{x_m}", PointCloud(xyz, rgb=np.zeros((count, 3), np.uint8), frame="map"))


def test_tiles_share_no_point_and_are_256_points_wide():
    tiles = cut(join(spread(0.0), spread(30.0)), 0.1)
    assert sorted(len(tile.cloud) for tile in tiles) == [1000, 1000]
    assert len({tile.name for tile in tiles}) == 2


def join(*parts: Points) -> PointCloud:
    return PointCloud(np.concatenate([part.cloud.xyz for part in parts]), frame="map")


def test_far_points_are_thinned_first_until_the_limit_is_kept():
    parts = [spread(x_m) for x_m in (1.0, 10.0, 100.0)]
    assert halvings(parts, np.zeros(3), 3000) == [0, 0, 0]
    for limit in (2000, 1500, 500, 100, 10):
        times = halvings(parts, np.zeros(3), limit)
        assert times == sorted(times)
        kept = sum(len(part.cloud.xyz[:: 1 << n]) for part, n in zip(parts, times, strict=True))
        assert kept <= limit


def test_a_click_finds_the_nearest_point_on_its_ray_or_none():
    parts = [spread(5.0), spread(50.0)]
    for part, number in ((parts[0], 7), (parts[1], 7)):
        aim = part.cloud.xyz[number].astype(np.float64)
        (hit,) = pick([part], np.zeros(3), aim / np.linalg.norm(aim)).xyz
        assert np.linalg.norm(np.cross(hit, aim)) / np.linalg.norm(aim) < 0.006 * 51
        assert np.linalg.norm(hit) <= np.linalg.norm(aim) + 1e-6
    assert pick(parts, np.zeros(3), np.array([-1.0, 0.0, 0.0])) is None


def test_what_a_ray_passes_within_a_radius_is_hit_and_what_is_behind_it_is_not():
    part = Points("", PointCloud(np.array([(5, 0.8, 0), (-5, 0, 0)], np.float32)))
    ray = np.zeros(3), np.array([1.0, 0.0, 0.0])
    assert pick([part], *ray) is None
    (hit,) = pick([part], *ray, 1.0).xyz
    assert hit.tolist() == [5, np.float32(0.8), 0]


class Shown:
    """Takes the mesh that is added to a page."""

    def add_mesh_trimesh(self, name: str, mesh: object) -> None:
        self.mesh = mesh


@pytest.fixture
def ramp() -> GroundSurface:
    """Ground that rises by 0.5 m a metre in x, and is not known in the last columns."""
    x = np.arange(20) + 0.5
    heights = np.where(x < 16, 0.5 * x, np.nan)
    return GroundSurface(np.tile(heights, (10, 1)), 1.0, (0.0, 0.0))


def test_a_grid_lies_on_the_ground_and_its_cells_at_their_places(ramp):
    pytest.importorskip("trimesh", reason="the extra view is not installed")
    cells = np.full((20, 40), UNKNOWN, np.int8)
    cells[:, :34], cells[4, 11] = FREE, OCCUPIED
    shown = Shown()
    server._add_grid(shown, "grid", OccupancyGrid(cells, 0.5, (0.0, 0.0)), ramp)
    mesh, rgb = shown.mesh, shown.mesh.visual.vertex_colors[:, :3]
    x, y, _ = mesh.vertices.T
    inner = (x > 1) & (x < 15) & (y < 10)  # whose neighbours are known, too
    np.testing.assert_allclose(
        mesh.vertices[inner, 2], 0.5 * mesh.vertices[inner, 0] + 0.25, atol=1e-6
    )
    assert (mesh.face_normals[:, 2] > 0).all()
    # Of the cells that are known, those whose ground is.
    assert mesh.bounds[:, :2].tolist() == [[0, 0], [16, 10]]
    assert mesh.area_faces.sum() > 160.0
    (occupied,) = {tuple(one) for one in rgb.tolist()} - {tuple(rgb[0].tolist())}
    corners = mesh.vertices[(rgb == occupied).all(axis=1), :2]
    assert (corners.min(axis=0).tolist(), corners.max(axis=0).tolist()) == ([5.5, 2], [6, 2.5])


def test_cells_of_a_large_grid_are_merged_and_no_obstacle_is_lost(ramp, monkeypatch):
    pytest.importorskip("trimesh", reason="the extra view is not installed")
    monkeypatch.setattr(server, "_MOST_CELLS", 60)
    cells = np.full((19, 32), FREE, np.int8)
    cells[7, 13] = OCCUPIED
    shown = Shown()
    server._add_grid(shown, "grid", OccupancyGrid(cells, 0.5, (0.0, 0.0)), ramp)
    mesh, rgb = shown.mesh, shown.mesh.visual.vertex_colors[:, :3]
    assert len(mesh.faces) == 2 * 5 * 8
    assert (rgb != rgb[0]).any(axis=1).sum() == 4
    occupied = mesh.vertices[(rgb != rgb[0]).any(axis=1), :2]
    assert occupied.min(axis=0).tolist() == [6, 2]
