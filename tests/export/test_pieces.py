"""Cut meshes meet without a gap, and the surface of a drive is built of such tiles."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recon.commands.config import load_config
from recon.core.errors import MeshingError, OutputError
from recon.core.values import OccupancyVoxels, PointCloud, TriangleMesh
from recon.export.mesh import cut, pieces, poisson
from recon.export.mesh.pieces import export_mesh
from recon.export.mesh.poisson import MeshSettings, reconstruct_map_surface
from recon.io.models.mesh import read_mesh
from recon.io.models.ply import write_ply
from recon.map.tiles import Tiles
from recon.run.directory import RunDirectory
from tests.map.walls import put_cloud, put_voxels


def border(mesh, plane):
    """Return the open edges (E, 2, 3) of a mesh in a plane."""
    return mesh.vertices[cut.open_corners(mesh, plane)[:, :2]]


def sheet(seed: int, n: int = 24, shift_m: float = 0.0, noise_m: float = 0.0) -> TriangleMesh:
    """A wavy sheet over [-1, 1]², triangles as its vertices were jittered; it faces up."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    x, y = (v + rng.uniform(-0.4 / n, 0.4 / n, v.shape) for v in (x, y))
    z = 0.1 * np.sin(3 * x) * np.cos(4 * y) + shift_m + rng.normal(0, noise_m, x.shape)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    around = (corner, corner + n, corner + n + 1), (corner, corner + n + 1, corner + 1)
    faces = np.concatenate([np.stack(corners, axis=1) for corners in around])
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    rgb = np.repeat(np.uint8(127 + 120 * x.ravel()[:, None].clip(-1, 1)), 3, axis=1)
    normals = np.tile(np.float32([0, 0, 1]), (n * n, 1))
    return TriangleMesh(vertices, faces.astype(np.int32), normals, rgb)


def ups(mesh: TriangleMesh) -> np.ndarray:
    """The normals of the faces, twice as long as their areas."""
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def area_m2(mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(ups(mesh), axis=1).sum() / 2)


@given(axis=st.integers(0, 1), at=st.floats(-0.9, 0.9), seed=st.integers(0, 5))
def test_the_halves_are_the_whole(axis, at, seed):
    mesh, plane = sheet(seed), cut.Plane(axis, at)
    halves = [cut.cut_mesh(mesh, plane, keep_above=above) for above in (False, True)]
    # float32 places new vertices to 1e-7 m.
    assert sum(map(area_m2, halves)) == pytest.approx(area_m2(mesh), rel=1e-5)
    assert halves[0].vertices[:, axis].max() == np.float32(at)
    assert halves[1].vertices[:, axis].min() == np.float32(at)
    for half in halves:
        assert (ups(half)[:, 2] > -1e-9).all()
        assert set(np.unique(half.faces)) == set(range(len(half.vertices)))
    borders = [np.unique(border(half, plane).reshape(-1, 3), axis=0) for half in halves]
    np.testing.assert_array_equal(borders[0], borders[1])


def test_new_vertices_have_normals_and_colours_between():
    half = cut.cut_mesh(sheet(0), cut.Plane(0, 0.0), keep_above=True)
    on_plane = half.vertices[:, 0] == 0
    assert np.abs(half.rgb[on_plane].astype(int) - 127).max() <= 12
    np.testing.assert_allclose(np.linalg.norm(half.normals, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("above", [True, False])
def test_a_mesh_on_one_side_is_kept_or_dropped_whole(above):
    mesh = sheet(1)
    kept = cut.cut_mesh(mesh, cut.Plane(0, -5.0 if above else 5.0), keep_above=above)
    np.testing.assert_array_equal(kept.vertices[kept.faces], mesh.vertices[mesh.faces])
    dropped = cut.cut_mesh(mesh, cut.Plane(0, 5.0 if above else -5.0), keep_above=above)
    assert (len(dropped.faces), len(dropped.vertices)) == (0, 0)


def gaps_m(one: TriangleMesh, other: TriangleMesh, plane: cut.Plane) -> np.ndarray:
    """How far points along each border are from the other border."""
    borders, found = [border(mesh, plane) for mesh in (one, other)], []
    along = np.linspace(0, 1, 7, dtype=np.float32)[None, :, None]
    for here, there in (borders, borders[::-1]):
        points = here[:, :1] * (1 - along) + here[:, 1:] * along
        found.append(cut.nearest_on_edges(points.reshape(-1, 3), there).distance_m)
    return np.concatenate(found)


@pytest.mark.parametrize("n", [12, 24, 57])
def test_a_seam_between_two_versions_of_a_surface_is_closed(n):
    plane = cut.Plane(0, 0.1)
    left = cut.cut_mesh(sheet(2), plane, keep_above=False)
    right = cut.cut_mesh(sheet(3, n, shift_m=0.02, noise_m=0.005), plane, keep_above=True)
    assert gaps_m(left, right, plane).max() > 0.01
    closed = cut.close_seam(right, plane, border(left, plane), 0.2)
    # Both ends of the seam lie where the sheets end, up to 0.02 m apart.
    assert gaps_m(_within(left, 0.9), _within(closed, 0.9), plane).max() < 1e-5
    assert area_m2(closed) == pytest.approx(area_m2(right), rel=0.02)
    assert (ups(closed)[:, 2] > -1e-9).all()


def _within(mesh: TriangleMesh, y_m: float) -> TriangleMesh:
    """The mesh between two planes across y."""
    below = cut.cut_mesh(mesh, cut.Plane(1, y_m), keep_above=False)
    return cut.cut_mesh(below, cut.Plane(1, -y_m), keep_above=True)


def test_a_seam_whose_neighbour_is_far_stays_as_it_is():
    plane = cut.Plane(0, 0.0)
    left = cut.cut_mesh(sheet(2), plane, keep_above=False)
    right = cut.cut_mesh(sheet(3, shift_m=1.0), plane, keep_above=True)
    closed = cut.close_seam(right, plane, border(left, plane), 0.2)
    np.testing.assert_array_equal(closed.vertices, right.vertices)
    np.testing.assert_array_equal(closed.faces, right.faces)


@given(st.lists(st.tuples(*[st.integers(0, 11)] * 3), min_size=1, max_size=24))
def test_faces_that_share_an_edge_are_one_component_numbered_by_its_first_face(corners):
    faces = np.array(corners, np.int32)
    sides = [{frozenset(pair) for pair in zip(one, np.roll(one, -1), strict=True)} for one in faces]
    expected = [*range(len(faces))]
    for one, other in combinations(range(len(faces)), 2):
        if sides[one] & sides[other]:
            low, high = sorted((expected[one], expected[other]))
            expected = [low if label == high else label for label in expected]
    labels, sizes = cut.component_labels(faces)
    numbers = {label: number for number, label in enumerate(sorted(set(expected)))}
    np.testing.assert_array_equal(labels, [numbers[label] for label in expected])
    np.testing.assert_array_equal(sizes, np.bincount(labels))


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def test_faces_and_normals_of_a_square_are_kept_dropped_and_weighed():
    vertices, faces = cut.keep_vertices(SQUARE, HALVES, np.array([True, False, True, True]))
    np.testing.assert_array_equal(vertices, SQUARE[[0, 2, 3]])
    np.testing.assert_array_equal(faces, [[0, 1, 2]])
    both = np.concatenate([HALVES, [[4, 5, 6]]]).astype(np.int32)
    kept, left = cut.drop_small_components(np.concatenate([SQUARE, SQUARE[:3] + 10]), both, 2)
    np.testing.assert_array_equal(kept, SQUARE)
    np.testing.assert_array_equal(left, HALVES)
    with pytest.raises(MeshingError, match="trimming left no face"):
        cut.drop_small_components(SQUARE, HALVES, 3)
    np.testing.assert_allclose(cut.vertex_normals(SQUARE, HALVES), [[0, 0, 1]] * 4)
    np.testing.assert_allclose(cut.vertex_normals(SQUARE, HALVES[:, ::-1]), [[0, 0, -1]] * 4)
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, -1]], dtype=np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    # Areas 4.5 (normal z) and 1.5 (normal -x) at the shared vertices.
    expected = np.array([-1.5, 0, 4.5]) / np.hypot(1.5, 4.5)
    np.testing.assert_allclose(cut.vertex_normals(vertices, faces)[0], expected, atol=1e-6)


@pytest.fixture(autouse=True)
def untrimmed(monkeypatch):
    monkeypatch.setattr(poisson, "_LEAST_SUPPORTED", 0.0)


STEP_M = 0.1
CONFIG = load_config(None, ["submaps.tile_m=6.4"])
SETTINGS = MeshSettings(tile_m=8.0)


def street() -> PointCloud:
    """A bumpy street from x = -2 to 11.5 m, 6 m wide, with a wall along it; 1 cm of noise."""
    rng = np.random.default_rng(0)
    x, y = (axes.ravel() for axes in np.mgrid[-2:11.5:STEP_M, -3:3:STEP_M])
    ground = np.stack([x, y, 0.1 * np.sin(x) + 0.05 * np.cos(2 * y)], axis=1)
    along, up = (axes.ravel() for axes in np.mgrid[-2:11.5:STEP_M, 0.3:2.5:STEP_M])
    wall = np.stack([along, np.full_like(along, 3.0), up], axis=1)
    xyz = np.concatenate([ground, wall]) + rng.normal(0, 0.01, (len(ground) + len(wall), 3))
    sizes = [len(ground), len(wall)]
    normals = np.repeat([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], sizes, axis=0).astype(np.float32)
    rgb = np.repeat([[90] * 3, [200] * 3], sizes, axis=0).astype(np.uint8)
    return PointCloud(xyz.astype(np.float32), rgb, normals, frame="map")


@pytest.fixture
def store(monkeypatch):
    """The street in tiles, which overlap as little as the pieces of 8 m, which are small, do."""
    monkeypatch.setattr("recon.export.mesh.pieces.OVERLAP_M", 1.5)
    store = Tiles(CONFIG, np.eye(4))
    cloud = street()
    # As from a drive: in pieces that do not know the tiles.
    for part in np.array_split(np.arange(len(cloud)), 7):
        put_cloud(store, cloud.select(part))
    return store


def written(store, folder, settings=SETTINGS, threads=None):
    """The whole mesh, that of each tile, and the warnings."""
    with RunDirectory(folder) as directory:
        layer = directory.path("mesh/cloud.ply")
        write_ply(layer, street())
        found = export_mesh(store, settings, directory.path("mesh/mesh.ply"), layer, threads)
        directory.write_json("run.json", {"files": directory.files()})
    tiles = [*map(read_mesh, sorted((folder / "mesh" / "tiles").glob("*.ply")))]
    return read_mesh(folder / "mesh" / "mesh.ply"), tiles, list(found.warnings)


@pytest.mark.parametrize("way", ["grid", "poisson"])
def test_tiles_lie_on_the_surface_without_gaps_and_are_the_whole(store, tmp_path, way):
    settings = SETTINGS.model_copy(update={"surface": way})
    whole, tiles, warnings = written(store, tmp_path / "alone", settings, threads=1)
    assert (warnings, len(tiles)) == ([], 2)
    triangles = np.concatenate([tile.vertices[tile.faces] for tile in tiles])
    np.testing.assert_array_equal(whole.vertices[whole.faces], triangles)
    # Within what was sampled; beyond it the surface goes on for two spacings, as it likes.
    inside = (np.abs(whole.vertices[:, 1]) < 2.5) & (np.abs(whole.vertices[:, 0] - 5) < 6)
    x, y, z = whole.vertices[inside].T
    # Noise of 1 cm is smoothed; an octree cell of 0.1 m adds little on a bump of 1 m.
    assert np.abs(z - 0.1 * np.sin(x) - 0.05 * np.cos(2 * y)).max() < 0.03
    assert set(np.unique(whole.rgb)) >= {90, 200}
    distance_m = gaps_m(*tiles, cut.Plane(0, 4.0))
    assert len(distance_m) > 2 * 60 * 7
    assert distance_m.max() < 0.1
    assert np.percentile(distance_m, 95) < 1e-4
    together = written(store, tmp_path / "at once", settings, threads=3)[0]
    np.testing.assert_array_equal(together.vertices, whole.vertices)
    np.testing.assert_array_equal(together.faces, whole.faces)


def apart_m(one: TriangleMesh, other: TriangleMesh) -> float:
    """How far a vertex of one mesh is at most from those of the other, and the other way round."""
    trees = [cKDTree(mesh.vertices.astype(np.float64)) for mesh in (one, other)]
    return max(a.query(b.data)[0].max() for a, b in (trees, trees[::-1]))


def test_cells_are_doubled_where_points_are_sparse():
    cloud, settings = street(), MeshSettings(min_component_faces=1)
    fine, coarse = (reconstruct_map_surface(cloud, settings, voxel_m) for voxel_m in (0.1, 0.025))
    np.testing.assert_array_equal(coarse.vertices[coarse.faces], fine.vertices[fine.faces])


def test_a_map_far_from_its_origin_has_the_same_surface():
    cloud, settings = street(), MeshSettings()
    here = reconstruct_map_surface(cloud, settings, 0.1)
    there = reconstruct_map_surface(
        replace(cloud, xyz=cloud.xyz + np.float32(2**13)), settings, 0.1
    )
    # float32 resolves a millimetre at eight kilometres.
    back = replace(there, vertices=there.vertices - np.float32(2**13))
    # float32 resolves a millimetre at eight kilometres: a point may change sides of its cell.
    assert apart_m(back, here) < 0.1 + 0.001
    assert area_m2(back) == pytest.approx(area_m2(here), rel=1e-3)


def test_a_target_is_that_of_all_tiles(store, tmp_path):
    settings = SETTINGS.model_copy(update={"target_faces": 4000})
    whole, _, _ = written(store, tmp_path / "out", settings)
    assert 3000 < len(whole.faces) < 5000


def test_what_hangs_where_cameras_looked_is_cut_off(store, tmp_path, monkeypatch):
    ball = np.random.default_rng(5).normal(0, 1, (3000, 3)).astype(np.float32)
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    xyz, rgb = 0.5 * ball + np.float32([1.0, 0.0, 1.6]), np.full((3000, 3), 255, np.uint8)
    put_cloud(store, PointCloud(xyz, rgb, ball, frame="map"))
    cells = np.stack(np.meshgrid(*[np.arange(-8, 20)] * 2, np.arange(3, 13), indexing="ij"), -1)
    free = cells.reshape(-1, 3).astype(np.int32)
    put_voxels(store, OccupancyVoxels(free, np.full(len(free), -1, np.float32), 0.2))
    with monkeypatch.context() as patched:
        patched.setattr(pieces, "looked_through", lambda xyz, voxels: np.zeros(len(xyz), np.bool_))
        kept = written(store, tmp_path / "kept")[0]
    assert (kept.vertices[:, 2] > 1.0).sum() > 500
    whole = written(store, tmp_path / "cut")[0]
    above = whole.vertices[(whole.vertices[:, 2] > 1.0) & (whole.vertices[:, 1] < 2.5)]
    assert len(above) == 0


def flat(low: tuple[float, float], high: tuple[float, float], z_m: float) -> PointCloud:
    """A level rectangle of points, above the street."""
    x, y = (a.ravel() for a in np.mgrid[low[0] : high[0] : STEP_M, low[1] : high[1] : STEP_M])
    xyz = np.stack([x, y, np.full_like(x, z_m)], axis=1).astype(np.float32) + np.float32(0.02)
    normals = np.tile(np.float32([0, 0, 1]), (len(xyz), 1))
    return PointCloud(xyz, np.full((len(xyz), 3), 50, np.uint8), normals, frame="map")


def components(mesh: TriangleMesh) -> list[list[float]]:
    """Corners of the box around each component of a mesh whose tiles are welded, 0.1 m."""
    places = np.unique(np.rint(mesh.vertices * 1e3), axis=0, return_inverse=True)[1].ravel()
    faces = places[mesh.faces]
    links = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    size = places.max() + 1
    ones = coo_matrix((np.ones(len(links)), links.T), shape=(size, size))
    label = connected_components(ones, directed=False)[1][places]
    boxes = [mesh.vertices[label == one] for one in np.unique(label)]
    return sorted(np.rint(10 * np.concatenate([b.min(0), b.max(0)])).tolist() for b in boxes)


def test_components_are_counted_over_all_tiles(store, tmp_path):
    # A ribbon of which a tile and its margin have only the tip; and a crumb over the seam.
    put_cloud(store, flat((-1.5, 0.0), (4.6, 0.15), 2.0))
    put_cloud(store, flat((3.8, -1.5), (4.2, -1.2), 2.0))
    large = SETTINGS.model_copy(update={"min_component_faces": 180})
    found = [written(store, tmp_path / "tiled", large)[0]]
    found.append(written(store, tmp_path / "whole", large.model_copy(update={"tile_m": 50.0}))[0])
    assert components(found[0]) == components(found[1])
    assert len(components(found[0])) == 2
    every = written(store, tmp_path / "all", SETTINGS.model_copy(update={"min_component_faces": 1}))
    assert len(components(every[0])) == 3
    with pytest.raises(MeshingError, match="no component of 1000000 faces"):
        written(
            store, tmp_path / "none", SETTINGS.model_copy(update={"min_component_faces": 10**6})
        )


def test_tiles_with_too_few_points_are_reported_and_none_is_an_error(store, tmp_path):
    with pytest.raises(MeshingError, match="no part of the map gives a surface"):
        written(Tiles(CONFIG, np.eye(4)), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError):
        written(store, tmp_path / "out")
    stray = np.array([[60, 60, 0], [61, 60, 0], [90, 90, 0]], dtype=np.float32)
    cloud = street().select(np.arange(3))
    put_cloud(store, PointCloud(stray, rgb=cloud.rgb, normals=cloud.normals, frame="map"))
    coarse = SETTINGS.model_copy(update={"depth": 5})
    warnings = written(store, tmp_path / "few", coarse)[2]
    assert len(warnings) == 1
    assert warnings[0].startswith("no surface in 2 of 4 tiles, 0.0% of the points (too few points")
