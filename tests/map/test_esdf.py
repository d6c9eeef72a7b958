"""The signed distance to what is occupied: that of the shape which was voxelised, without seams."""

import tracemalloc
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest

import recon
from recon.core.errors import FormatError, MappingError, ShapeError
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyVoxels
from recon.core.values.arrays import Bool, Float64, Int64
from recon.map.esdf import DistanceField
from recon.map.tiles import Tiles
from tests.map import walls

RES_M = 0.2
FULL, EMPTY = np.float32(2.0), np.float32(-1.5)


def field_of(keys: Int64, occupied: Bool, *settings: str) -> DistanceField:
    tiles = Tiles(recon.load_config(None, [*settings]), np.eye(4))
    log_odds = np.where(occupied, FULL, EMPTY)
    walls.put_voxels(tiles, OccupancyVoxels(keys.astype(np.int32), log_odds, RES_M))
    low, high = keys.min(axis=0)[:2].tolist(), (keys.max(axis=0) + 1)[:2].tolist()
    tiles.extent = (tuple(low), tuple(high))
    return DistanceField(tiles)


def box_of_cells(low: tuple[int, ...], high: tuple[int, ...]) -> Int64:
    ranges = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)


def sphere(at: Float64) -> Float64:
    return np.linalg.norm(at - [0.3, -0.1, 0.2], axis=1) - 1.37


def box(at: Float64) -> Float64:
    beyond = np.abs(at - [0.4, 0.0, -0.2]) - [1.2, 0.6, 0.8]
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0)


def wall(at: Float64) -> Float64:
    return at[:, 0] - 0.4


def slope(at: Float64) -> Float64:
    return (at - 0.1) @ [0.36, 0.48, 0.8]


@pytest.mark.parametrize("shape", [sphere, box, wall, slope])
def test_distances_are_those_of_the_shape_within_a_voxel(shape: Callable[[Float64], Float64]):
    keys = box_of_cells((-15,) * 3, (15,) * 3)
    field = field_of(keys, shape((keys + 0.5) * RES_M) < 0)
    # In the middle half, of which no edge of what is known is nearest.
    places = np.random.default_rng(0).uniform(-1.5, 1.5, (4000, 3))
    found, gradient = field.at(places)
    true = shape(places)
    assert np.abs(found - true).max() <= RES_M
    # Where a voxel is cut by the surface, it is all of one kind.
    clear = np.abs(true) > RES_M
    np.testing.assert_array_equal(np.sign(found[clear]), np.sign(true[clear]))
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1, atol=1e-9)
    # A step along the gradient leads away from it, as far except between two cubes.
    step = 0.2 * RES_M
    gained = (field.at(places + step * gradient)[0] - found)[found > 0]
    assert gained.max() <= step + 1e-9
    assert gained.min() > 0
    assert np.mean(gained > 0.99 * step) > 0.6
    ahead = shape(places + 0.01 * gradient) - true
    assert np.mean(ahead[clear] > 0.005) > 0.95  # within 60 deg of the true one


def test_a_wall_has_exactly_its_distance_and_normal():
    keys = box_of_cells((0, -20, -20), (20, 20, 20))
    field = field_of(keys, keys[:, 0] == 0)
    places = np.random.default_rng(1).uniform([0.2, -1, -1], [3, 1, 1], (500, 3))
    found, gradient = field.at(places)
    np.testing.assert_allclose(found, places[:, 0] - 0.2, atol=1e-9)
    np.testing.assert_allclose(gradient, np.tile([1.0, 0.0, 0.0], (500, 1)), atol=1e-9)


def random_cells(seed: int, size: int = 24) -> tuple[Int64, Bool]:
    rng = np.random.default_rng(seed)
    keys = box_of_cells((-size,) * 3, (size, size, 8 - size))
    keys = keys[rng.random(len(keys)) < 0.7]
    return keys, rng.random(len(keys)) < 0.004


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_cube_is_that_of_all(seed):
    keys, occupied = random_cells(seed)
    field = field_of(keys, occupied)
    rng = np.random.default_rng(seed)
    places = (keys[rng.permutation(len(keys))[:400]] + rng.random((400, 3))) * RES_M
    found, gradient = field.at(places)
    cubes = (keys[occupied] + 0.5) * RES_M
    off = places[:, None] - cubes
    all_m = np.linalg.norm(np.maximum(np.abs(off) - RES_M / 2, 0), axis=2).min(axis=1)
    free = found > 0
    assert free.mean() > 0.9
    np.testing.assert_allclose(found[free], np.minimum(all_m[free], 5.0), atol=1e-9)
    far = found == 5.0
    assert not gradient[far].any()


@pytest.mark.parametrize("tile_m", [1.6, 3.2])
def test_borders_of_tiles_make_no_seam(tile_m):
    keys, occupied = random_cells(7)
    cut = field_of(keys, occupied, f"submaps.tile_m={tile_m}")
    whole = field_of(keys, occupied, "submaps.tile_m=100")
    assert len(whole.tiles) == 4  # one at each side of the origin
    assert len(cut.tiles) >= 16
    # Not from the centres, from which several cubes may be as near.
    places = (keys + np.random.default_rng(0).random(keys.shape)) * RES_M
    for ours, theirs in zip(cut.at(places), whole.at(places), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    for tile in cut.tiles:
        mine, distance_m = cut.of_tile(tile.key)
        expected = whole.at((mine + 0.5) * RES_M)[0].astype(np.float32)
        np.testing.assert_array_equal(distance_m, expected)


def test_unknown_space_has_no_distance_and_is_no_obstacle():
    keys = box_of_cells((0, 0, 0), (60, 3, 3))
    hole = (keys[:, 0] >= 10) & (keys[:, 0] < 20)
    field = field_of(keys[~hole], (keys[:, 0] == 0)[~hole])
    at = np.array([[9.9, 0.3, 0.3], [3.0, 0.3, 0.3], [1.9, 0.3, 0.3], [1.9, 0.3, 0.7], [-9, 9, 9]])
    found, gradient = field.at(at)
    np.testing.assert_allclose(found, [5.0, np.nan, 1.7, np.nan, np.nan], atol=1e-9)
    np.testing.assert_array_equal(np.isnan(gradient).all(axis=1), np.isnan(found))
    assert not gradient[0].any()
    # An obstacle with nothing free in reach is as deep as that.
    alone = field_of(np.array([[0, 0, 0]]), np.array([True]))
    assert alone.at(np.array([[0.1, 0.1, 0.1]]))[0] == -5.0


def test_on_faces_edges_and_corners_there_is_a_gradient():
    keys = box_of_cells((-3,) * 3, (4,) * 3)
    field = field_of(keys, ~keys.any(axis=1))
    places = np.array([*product((0.0, 0.1, 0.2), repeat=3)])
    found, gradient = field.at(places)
    inside = (places == 0.1).all(axis=1)
    np.testing.assert_allclose(found, np.where(inside, -0.1, 0), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1, atol=1e-9)


def test_a_field_holds_a_tile_and_its_margin_in_memory_however_long_the_map_is():
    def peak_mb(length: int) -> float:
        keys = box_of_cells((0, 0, 0), (length, 30, 10))
        field = field_of(keys, keys[:, 2] == 0, "submaps.tile_m=6.4")
        del keys
        tracemalloc.start()
        cells = sum(len(field.of_tile(tile.key)[0]) for tile in field.tiles)
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        assert cells == length * 30 * 10
        return peak

    assert peak_mb(384) < 1.2 * peak_mb(128)


@pytest.fixture(scope="module")
def along_a_wall():
    with walls.drives(1) as map_:
        yield map_


def test_a_map_says_how_far_places_are_from_what_is_occupied(along_a_wall):
    before, inside, behind = places = np.array([[10.0, y, 0.0] for y in (-1.5, -3.03, -5.0)])
    found, gradient = along_a_wall.distance(places, gradient=True)
    assert found.dtype == gradient.dtype == np.float64
    assert found[0] == pytest.approx(walls.WALL_M - 1.5, abs=RES_M)
    assert -RES_M < found[1] < 0
    assert np.isnan(found[2])
    assert gradient[0] @ [0, 1, 0] > 0.95
    assert gradient[1] @ [0, 1, 0] > 0.95
    for place, expected in zip((before, inside, behind), found, strict=True):
        np.testing.assert_array_equal(along_a_wall.distance(place), [expected])


def test_the_file_is_what_the_map_says(along_a_wall, tmp_path):
    made = recon.export_map(along_a_wall, "esdf", tmp_path / "esdf.npz")
    with np.load(tmp_path / "esdf.npz") as found:
        whole = np.full(found["shape"], np.nan, np.float32)
        whole[tuple(found["cells"].T)] = found["distance_m"]
        states = np.full(found["shape"], UNKNOWN, np.int8)
        states[tuple(found["cells"].T)] = found["state"]
        centres = (np.argwhere(np.ones_like(states)) + 0.5) * found["resolution_m"]
        centres += found["origin_m"]
        assert found["max_distance_m"] == 5.0
    np.testing.assert_allclose(along_a_wall.distance(centres), whole.ravel(), rtol=1e-6)
    np.testing.assert_array_equal(along_a_wall.at(centres).state, states.ravel())
    counts = made.figures.to_json()
    assert counts["esdf_occupied"] == (states == OCCUPIED).sum() > 50
    assert counts["esdf_free"] == (states == FREE).sum() > 1000


@pytest.mark.parametrize(
    "wrong", [[1.0, 2.0], "abc", None, [[0, 0, np.nan]], [0, np.inf, 0], [[1, 2, 3], [1]], [[[1]]]]
)
def test_what_is_no_place_is_refused(along_a_wall, wrong):
    with pytest.raises(ShapeError, match=r"\(3,\) or \(N, 3\)"):
        along_a_wall.distance(wrong)


def test_no_places_and_those_beyond_what_a_voxel_can_be_have_no_distance(along_a_wall):
    assert len(along_a_wall.distance(np.zeros((0, 3)))) == 0
    assert np.isnan(along_a_wall.distance([[1e12, 0, 0], [0, 0, -1e12]])).all()


def test_a_map_without_drives_rays_or_anything_seen_is_refused(tmp_path):
    with recon.Map.temporary() as empty, pytest.raises(FormatError, match="no drive"):
        empty.distance([0, 0, 0])
    config = recon.load_config(walls.CONFIG, {"occupancy.keep_rays": False})
    with recon.Map.temporary() as map_:
        walls.drive(map_, walls.TRUE[0], 0, config=config)
        map_.store.delete("rays")
        for session in map_.sessions:
            session.submaps.entries[:] = []
        with pytest.raises(FormatError, match="kept no rays"):
            map_.distance([0, 0, 0])
    health = dict.fromkeys(range(4), recon.OdometryHealth(ok=False))
    with recon.Map.temporary() as map_:
        walls.drive(map_, walls.TRUE[0][:4], 0, health=health)
        with pytest.raises(MappingError, match="nothing was observed"):
            map_.distance([0, 0, 0])
        with pytest.raises(MappingError, match="nothing was observed"):
            recon.export_map(map_, "esdf", tmp_path / "esdf.npz")
    assert not [*tmp_path.iterdir()]
