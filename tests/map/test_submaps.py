"""A drive divided into submaps or cut into tiles gives the map of one; fusion averages frames."""

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply, exp_so3, make_transform, transform_cloud
from recon.core.kernels.voxels import are_among, pack_keys
from recon.core.values import OccupancyVoxels, PointCloud, RectifiedCamera, join_voxels
from recon.core.values.arrays import Float64, tree_of
from recon.core.values.camera import depth_sigma
from recon.map import fusion
from recon.map.builders import CloudBuilder, OccupancyBuilder, Submap, SubmapSettings
from recon.map.cut import Rectangle
from recon.map.drive import mapper as mapper_file
from recon.map.drive.mapper import SubmapBuilder
from recon.map.fusion import FusedPart, FusionSettings, fusion_range_m, join_fused
from recon.map.ground.surface import find_floors
from recon.map.kernels.raycast import BLOCK_BITS
from recon.map.map import Map
from recon.map.occupancy.part import free_part, join_occupancy
from recon.map.store.session import Submaps
from recon.map.tiles import Tiles
from recon.stereo.frame import drop_islands
from tests.map.walls import (
    CONFIG,
    T_MAP_WORLD,
    TRUE,
    WALL_M,
    assert_same_voxels,
    cloud_of,
    drive,
    frames,
    put_cloud,
    put_voxels,
    voxels_of,
)

FUSION, OCCUPANCY = CONFIG.fusion, CONFIG.occupancy
VOXEL_M, RESOLUTION_M = FUSION.voxel_m, OCCUPANCY.resolution_m


def _builder(length_m: float, max_bytes: int | None = None) -> SubmapBuilder:
    settings = SubmapSettings(length_m=length_m)
    return SubmapBuilder(settings, FUSION, OCCUPANCY, T_MAP_WORLD, max_bytes)


def _submaps(builder: SubmapBuilder, seen: list) -> list[Submap]:
    done = []
    for frame in seen:
        builder.integrate(*frame)
        if builder.full:
            done.append(builder.close())
    return [*done, builder.close()] if builder.frames else done


def test_submaps_put_together_are_the_map_of_the_whole_drive():
    submaps = _submaps(_builder(5.0), frames(24))
    fused, occupancy = CloudBuilder(FUSION), OccupancyBuilder(OCCUPANCY, T_MAP_WORLD)
    for there, here, T in frames(24):
        fused.integrate(there)
        occupancy.integrate(here, T)
    whole = fused.part().cloud(VOXEL_M, 1)
    parts = join_fused(submap.fused for submap in submaps).cloud(VOXEL_M, 1)
    assert len(submaps) > 3
    np.testing.assert_array_equal(parts.count, whole.count)
    # float32 sums in another order, rounded as maps keep them.
    for name, rtol, atol in (
        ("xyz", 0, 2e-5), ("normals", 0, 4e-3), ("sigma_m", 1e-4, 0), ("weight", 3e-4, 0)
    ):  # fmt: skip
        got, expected = getattr(parts, name), getattr(whole, name)
        np.testing.assert_allclose(got, expected, rtol=rtol, atol=atol)
    joined, points = (
        join_occupancy(submap.occupancy for submap in submaps),
        occupancy.part().points,
    )
    np.testing.assert_array_equal(joined.points.keys, points.keys)
    np.testing.assert_allclose(joined.points.sums, points.sums, rtol=1e-4, atol=1e-2)
    assert_same_voxels(joined.voxels(RESOLUTION_M), occupancy.voxels(), atol=1e-5)  # float32


@pytest.mark.parametrize(("length_m", "sizes"), [(10.0, [11, 10, 3]), (1000.0, [9, 9, 6])])
def test_a_submap_ends_after_its_path_its_frames_or_its_bytes(length_m, sizes, monkeypatch):
    monkeypatch.setattr(mapper_file, "_MAX_FRAMES", 9 if sizes[0] == 9 else 100)
    submaps = _submaps(_builder(length_m), frames(24))
    assert [(submap.index, submap.frames) for submap in submaps] == list(enumerate(sizes))
    assert [submap.first_frame for submap in submaps] == [0, sizes[0], sizes[0] + sizes[1]]
    small = _submaps(_builder(length_m, max_bytes=1), frames(3))
    assert [submap.frames for submap in small] == [1, 1, 1]


def test_a_builder_goes_on_from_the_state_of_another():
    first, second, done = _builder(8.0), _builder(8.0), []
    for frame in frames(24)[:13]:
        first.integrate(*frame)
        if first.full:
            done.append(first.close())
    second.restore(first.state())
    unbroken = _submaps(_builder(8.0), frames(24))
    resumed = [*done, *_submaps(second, frames(24)[13:])]
    assert len(resumed) == len(unbroken)
    for ours, theirs in zip(resumed, unbroken, strict=True):
        np.testing.assert_equal(tree_of(Submap.from_tree(tree_of(ours))), tree_of(theirs))


def _moved(submap: Submap, turn: float, step_m: list[float]) -> tuple[Submap, Float64]:
    T = make_transform(exp_so3(np.array([0.0, turn, 0.0])), np.array(step_m))
    return submap.moved(T, T_MAP_WORLD, VOXEL_M, RESOLUTION_M), T


def test_a_corrected_submap_has_thin_walls_where_the_correction_puts_them():
    [submap] = _submaps(_builder(1000.0), frames(24, noisy=True))
    moved, T = _moved(submap, 0.2, [0.7, -0.2, 3.0])
    before, after = (one.occupancy.voxels(RESOLUTION_M) for one in (submap, moved))
    places = after.centres_m[after.log_odds > 0.2]
    back = apply(T_MAP_WORLD @ np.linalg.inv(T) @ np.linalg.inv(T_MAP_WORLD), places)
    assert len(places) > 0.8 * (before.log_odds > 0.2).sum()
    # A voxel that a plane crosses has its centre at most half a diagonal from it.
    assert (np.abs(back[:, 1] + WALL_M) < 0.18).mean() > 0.99
    # 2 m forward and 0.8 m to the right: map x + 10 cells, y - 4 cells.
    after = _moved(submap, 0.0, [0.8, 0.0, 2.0])[0].occupancy.voxels(RESOLUTION_M)
    expected = {(i + 10, j - 4, k) for i, j, k in before.keys.tolist()}
    assert {tuple(key) for key in after.keys.tolist()} == expected
    assert after.log_odds.sum() == pytest.approx(before.log_odds.sum(), rel=1e-3)


def test_a_corrected_submap_has_its_points_where_the_correction_puts_them():
    [submap] = _submaps(_builder(1000.0), frames(6))
    moved, T = _moved(submap, 0.03, [0.7, -0.2, 3.0])
    before, after = (one.fused.cloud(VOXEL_M, 1) for one in (submap, moved))
    assert 0.8 * len(before) < len(after) <= len(before)
    gaps = np.linalg.norm(apply(T, before.xyz)[:, None] - after.xyz[None], axis=2).min(axis=1)
    # Means of voxels that come to lie in one are at most a voxel's diagonal away.
    assert gaps.max() < 0.18
    np.testing.assert_allclose(
        after.normals, np.tile(T[:3, :3] @ [-1, 0, 0], (len(after), 1)), atol=1e-5
    )  # float32
    assert moved.fused.sums[:, 0].sum() == pytest.approx(submap.fused.sums[:, 0].sum(), rel=1e-5)
    assert moved.fused.frames.max() <= submap.frames


CUT = load_config(None, ["submaps.length_m=4", "submaps.tile_m=6.4", "fusion.min_count=5"])
EVERYWHERE = Rectangle((-1e3, -1e3), (1e3, 1e3))


@pytest.fixture
def store():
    """A drive along a wall and back, so that a place is in several submaps."""
    there_and_back = np.concatenate([TRUE[0][:12], TRUE[0][11::-1]])
    return drive(Map.temporary(), there_and_back, 1, config=CUT).submaps


def _tiles(store: Submaps, T_corrected_world: Float64 | None = None) -> Tiles:
    return Tiles.of_submaps(store, CUT, T_MAP_WORLD, T_corrected_world)


def test_tiles_together_are_the_filtered_whole(store):
    tiles = _tiles(store, np.tile(np.eye(4), (len(store), 1, 1)))
    fused = join_fused(submap.fused for submap in store).cloud(0.1, 5)
    whole = transform_cloud(drop_islands(fused, CUT.map_filters.radius_m), T_MAP_WORLD, frame="map")
    assert sum(len(tile.cloud) > 0 for tile in tiles) >= 3
    assert 0 < len(whole) < len(fused)
    ours, theirs = cloud_of(tiles), whole.select(np.lexsort(whole.xyz.T))
    for name in ("xyz", "normals", "sigma_m", "weight", "count"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    occupancy = join_occupancy(submap.occupancy for submap in store)
    assert_same_voxels(voxels_of(tiles), occupancy.voxels(0.2))


def test_what_is_observed_later_changes_a_tile_as_in_one_long_drive(store):
    tiles = _tiles(store)
    seen = voxels_of(tiles)
    # Cells in all parts of the wall; three quarters of the way, most submaps have passed them.
    free = free_part(seen.keys[seen.log_odds > 0][::7], -2.0)
    number = 3 * len(store) // 4
    parts = [submap.occupancy for submap in store]
    expected = join_occupancy([*parts[: number + 1], free, *parts[number + 1 :]]).voxels(0.2)
    wide = [(tiles.bounds(tile.key), tiles.wide_voxels(tile.key, {number: free})) for tile in tiles]
    changed = join_voxels((v.select(inside.contains(v.centres_m)) for inside, v in wide), 0.2)
    assert_same_voxels(changed, expected)
    assert (expected.log_odds < 0).sum() > (seen.log_odds < 0).sum()


def test_the_voxels_of_some_blocks_are_those_of_the_whole(store):
    part = join_occupancy(submap.occupancy for submap in store)
    blocks = np.sort(part.rows.blocks[::3])
    some, whole = part.voxels(0.2, blocks), part.voxels(0.2)
    inside = are_among(pack_keys(whole.keys >> BLOCK_BITS), blocks)
    assert 0 < len(some) < len(whole)
    assert_same_voxels(some, whole.select(inside))
    assert len(part.voxels(0.2, blocks[:0])) == 0


def test_a_rectangle_has_the_points_and_voxels_of_all_tiles_below_it(store):
    tiles = _tiles(store)
    cloud, voxels = cloud_of(tiles), voxels_of(tiles)
    rectangle = Rectangle((3.0, -4.0), (14.5, 3.0))
    inside = rectangle.contains(cloud.xyz)
    assert 0 < inside.sum() < len(cloud)
    assert len(tiles.cloud_in(rectangle)) == inside.sum()
    assert len(tiles.voxels_in(rectangle)) == rectangle.contains(voxels.centres_m).sum() > 0
    floors = find_floors(voxels)
    assert len(tiles.floors_in(rectangle)) == rectangle.contains(floors).sum()
    assert len(tiles.cloud_in(Rectangle((600.0, 600.0), (610.0, 610.0)))) == 0


def test_points_and_voxels_that_are_put_in_come_out(store):
    made, filled = _tiles(store), Tiles(CUT, T_MAP_WORLD)
    cloud, voxels = cloud_of(made), voxels_of(made)
    for part in np.array_split(np.arange(len(cloud)), 5):  # in pieces that do not know the tiles
        put_cloud(filled, cloud.select(part))
    for part in np.array_split(np.arange(len(voxels)), 5):
        put_voxels(filled, voxels.select(part))
    np.testing.assert_array_equal(cloud_of(filled).xyz, cloud.xyz)
    assert_same_voxels(voxels_of(filled), voxels)
    assert all(filled.bounds(tile.key).contains(tile.cloud.xyz).all() for tile in filled)
    # A tile without points takes nothing from the others.
    far = OccupancyVoxels(np.int32([[40, 3, 0]]), np.ones(1, np.float32), filled.resolution_m)
    put_voxels(filled, far)
    sigma_m = filled.cloud_in(EVERYWHERE).sigma_m
    np.testing.assert_array_equal(np.sort(sigma_m), np.sort(cloud.sigma_m))


def test_a_path_that_leaves_a_rectangle_and_comes_back_is_in_pieces():
    path = np.array([[-5, 1, 0], [1, 1, 0], [2, 1, 0], [12, 1, 0], [15, 1, 0], [3, 2, 0]], float)
    inside = Rectangle((0.0, 0.0), (10.0, 10.0)).path(path)
    gap = [np.nan] * 3
    np.testing.assert_array_equal(inside, [[1, 1, 0], [2, 1, 0], gap, [3, 2, 0]])


HERE, ELSEWHERE = [0.05, 0.05, 0.05], [1.05, 1.05, 1.05]


def _cloud(xyz: object, **fields: object) -> PointCloud:
    arrays = {name: np.asarray(value) for name, value in fields.items()}
    return PointCloud(np.asarray(xyz, np.float32).reshape(-1, 3), frame="world", **arrays)


def _part(*clouds: PointCloud) -> FusedPart:
    builder = CloudBuilder(FusionSettings())
    for cloud in clouds:
        builder.integrate(cloud)
    return builder.part()


def _fused(*clouds: PointCloud, least: int = 1) -> PointCloud:
    return _part(*clouds).cloud(0.1, least)


def test_precise_voxels_need_one_frame_less(monkeypatch):
    # Two frames of 0.1 m make 0.071 m, two of 0.15 m make 0.106 m.
    cloud = _cloud([HERE, ELSEWHERE], sigma_m=np.float32([0.1, 0.15]))
    for limit, exported in ((0.8, 1), (0.7, 0), (1.1, 2)):
        monkeypatch.setattr(fusion, "_PRECISE", limit)
        assert len(_fused(cloud, cloud, least=3)) == exported
    monkeypatch.setattr(fusion, "_PRECISE", 100.0)
    assert (len(_fused(cloud, least=3)), len(_fused(cloud))) == (0, 2)


def test_points_weigh_by_their_precision_which_is_bounded_and_hopeless_ones_are_left_out():
    xyz = [[0.02, 0.05, 0.05], [0.07, 0.05, 0.05], ELSEWHERE, ELSEWHERE, [3.0, 3.0, 3.0]]
    fused = _fused(_cloud(xyz, sigma_m=np.float32([0.1, 0.2, 1e-9, 0.02, 5.0])))
    assert fused.xyz[0, 0] == pytest.approx((4 * 0.02 + 0.07) / 5, abs=1e-6)
    assert fused.weight == pytest.approx([100 + 25, 2 / 0.02**2], rel=1e-5)


@pytest.mark.parametrize(
    ("points", "frames", "sigma_m"), [(1, 1, 0.1), (50, 1, 0.1), (50, 4, 0.05)]
)
def test_frames_count_and_not_points(points, frames, sigma_m):
    cloud = _cloud([HERE] * points, sigma_m=np.full(points, 0.1, np.float32))
    fused = _fused(*[cloud] * frames)
    assert (fused.sigma_m, fused.count.tolist()) == (pytest.approx([sigma_m], rel=1e-5), [frames])


def test_what_is_known_is_averaged_by_confidence_and_opposite_normals_cancel():
    rgb = np.uint8([[0, 100, 255], [200, 100, 255], [9, 9, 9], [0] * 3, [0] * 3])
    normals = np.float32([[0, 0.6, 0.8], [0, -0.6, 0.8], [1, 0, 0], [0, 0, 1], [0, 0, -1]])
    confidence = np.float32([0.5, 0.5, 0.0, 0.5, 0.5])
    xyz = [HERE] * 3 + [[1.05, 0.05, 0.05]] * 2
    fused = _fused(_cloud(xyz, rgb=rgb, normals=normals, confidence=confidence))
    assert fused.xyz == pytest.approx(np.float32([HERE]), abs=1e-6)
    assert (fused.rgb.tolist(), fused.confidence.tolist()) == ([[100, 100, 255]], [0.5])
    assert fused.normals == pytest.approx(np.float32([[0, 0, 1]]), abs=1e-6)


def test_what_one_cloud_does_not_have_the_map_does_not_have():
    coloured, empty = _cloud(HERE, rgb=np.zeros((1, 3), np.uint8)), _cloud([])
    assert _fused(coloured, empty).rgb is not None
    fused = _fused(coloured, _cloud(HERE))
    assert (fused.rgb, fused.normals, fused.sigma_m) == (None, None, None)
    assert len(_fused()) == len(_fused(empty)) == 0


def test_a_part_is_gone_on_with_as_if_it_had_not_been_taken():
    plain, coloured = _cloud(HERE), _cloud(HERE, rgb=np.full((1, 3), 9, np.uint8))
    for before, rgb in (([coloured], [[9, 9, 9]]), ([plain], None), ([], [[9, 9, 9]])):
        builder = CloudBuilder(FusionSettings())
        builder.resume(_part(*before), len(before))
        builder.integrate(coloured)
        found, whole = builder.part().cloud(0.1, 1), _fused(*before, coloured)
        assert (None if found.rgb is None else found.rgb.tolist()) == rgb
        np.testing.assert_array_equal(found.count, whole.count)
        np.testing.assert_array_equal(found.xyz, whole.xyz)


@pytest.mark.parametrize(("cloud", "words"), [
    (PointCloud(np.zeros((1, 3), np.float32)), "world axes"),
    (_cloud([[np.nan, 0, 0]]), "not finite"),
    (_cloud([[1e9, 0, 0]]), "too far"),
    (_cloud([[0, 0, 0]], sigma_m=np.float32([np.nan])), "not finite"),
])  # fmt: skip
def test_clouds_that_would_spoil_the_map_are_refused(cloud, words):
    with pytest.raises(MappingError, match=words):
        _part(cloud)


def test_fusion_range_is_where_the_nominal_error_reaches_its_limit():
    camera = RectifiedCamera(700.0, 320.0, 120.0, 320.0, 0.5, 640, 240)
    range_m = fusion_range_m(camera, FusionSettings(max_depth_error_m=0.2))
    assert depth_sigma(np.array([range_m]), 0.3, camera)[0] == pytest.approx(0.2, rel=1e-6)
    assert fusion_range_m(camera, FusionSettings(max_depth_error_m=None)) == np.inf
