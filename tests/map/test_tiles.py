"""A map assembled tile by tile equals the whole map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import FormatError
from recon.core.geometry.se3 import exp_so3, make_transform, transform_cloud
from recon.core.values import OccupancyVoxels, PointCloud, join_clouds, join_voxels
from recon.core.values.arrays import Float32, Float64
from recon.map.cut import Rectangle
from recon.map.fusion import join_fused
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.ground.surface import find_floors
from recon.map.occupancy.part import free_part, join_occupancy
from recon.map.store.records import Store
from recon.map.store.session import Submaps
from recon.map.submaps import SubmapBuilder
from recon.map.tiles import Tiles
from recon.stereo.cloud.back_project import filter_cloud

T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
CONFIG = load_config(None, ["submaps.length_m=4", "submaps.tile_m=6.4", "fusion.min_count=2"])


def _fill(store: Submaps, config: ReconConfig = CONFIG) -> Submaps:
    """A drive along a wall and back, so that a place is in several submaps."""
    rng = np.random.default_rng(1)
    builder = SubmapBuilder(config.submaps, config.fusion, config.occupancy, T_MAP_WORLD)
    for z in [*range(12), *range(11, -1, -1)]:
        xyz = np.stack(
            [np.full(900, 2.03), rng.uniform(-1, 1, 900), rng.uniform(2, 9, 900)], axis=1
        ).astype(np.float32)
        fields = {
            "sigma_m": np.full(900, 0.1, np.float32),
            "normals": np.tile(np.float32([-1, 0, 0]), (900, 1)),
        }
        T = make_transform(np.eye(3), np.array([0.0, 0.0, float(z)]))
        world = PointCloud(xyz + np.float32([0, 0, z]), frame="world", **fields)
        builder.integrate(world, PointCloud(xyz, **fields), T)
        if builder.full:
            store.add(builder.close())
    if builder.frames:
        store.add(builder.close())
    return store


@pytest.fixture(params=["memory", "disk"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Submaps:
    path = tmp_path / "map.recon"
    return _fill(Submaps(Store.temporary() if request.param == "memory" else Store.create(path)))


def _tiles(store: Submaps, T_corrected_world: Float64 | None = None) -> Tiles:
    return Tiles.of_submaps(store, CONFIG, T_MAP_WORLD, T_corrected_world)


def _cloud(tiles: Tiles) -> PointCloud:
    return join_clouds(tile.cloud for tile in tiles)


def _voxels(tiles: Tiles) -> OccupancyVoxels:
    return join_voxels((tile.voxels for tile in tiles), tiles.resolution_m)


def _sorted(cloud: PointCloud) -> PointCloud:
    return cloud.select(np.lexsort(cloud.xyz.T))


def test_tiles_of_the_cloud_together_are_the_filtered_whole(store: Submaps) -> None:
    tiles = _tiles(store, np.tile(np.eye(4), (len(store), 1, 1)))
    fused = join_fused(submap.fused for submap in store).cloud(0.1, 2)
    whole = transform_cloud(filter_cloud(fused, CONFIG.map_filters), T_MAP_WORLD, frame="map")
    assert sum(len(tile.cloud) > 0 for tile in tiles) >= 3
    assert 0 < len(whole) < len(fused)
    ours, theirs = _sorted(_cloud(tiles)), _sorted(whole)
    for name in ("xyz", "normals", "sigma_m", "weight", "count"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_tiles_of_the_occupancy_together_are_the_whole(store: Submaps) -> None:
    tiled = _voxels(_tiles(store))
    whole = join_occupancy(submap.occupancy for submap in store).voxels(0.2)
    ours, theirs = np.lexsort(tiled.keys.T), np.lexsort(whole.keys.T)
    np.testing.assert_array_equal(tiled.keys[ours], whole.keys[theirs])
    np.testing.assert_array_equal(tiled.log_odds[ours], whole.log_odds[theirs])


def test_a_tile_is_made_once(store: Submaps, monkeypatch: pytest.MonkeyPatch) -> None:
    tiles = _tiles(store)
    first = [(tile.cloud.xyz, tile.voxels.keys) for tile in tiles]
    for name in ("join_fused", "join_occupancy"):
        monkeypatch.delattr(f"recon.map.tiles.{name}")
    again = [(tile.cloud.xyz, tile.voxels.keys) for tile in tiles]
    for ours, theirs in zip(again, first, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])


def test_what_is_observed_later_changes_a_tile_as_in_one_long_drive(store: Submaps) -> None:
    tiles, free = _tiles(store), -2.0
    seen = _voxels(tiles)
    # Cells in all parts of the wall; three quarters of the way, most submaps have passed them.
    hit = seen.keys[seen.log_odds > 0][::7]
    number = 3 * len(store) // 4
    parts = [submap.occupancy for submap in store]
    whole = join_occupancy([*parts[: number + 1], free_part(hit, free), *parts[number + 1 :]])
    expected = whole.voxels(0.2)
    changed = join_voxels(
        (
            wide.select(tiles.bounds(tile.key).contains(wide.centres_m))
            for tile in tiles
            for wide in [tiles.wide_voxels(tile.key, {number: free_part(hit, free)})]
        ),
        0.2,
    )
    ours, theirs = np.lexsort(changed.keys.T), np.lexsort(expected.keys.T)
    np.testing.assert_array_equal(changed.keys[ours], expected.keys[theirs])
    np.testing.assert_array_equal(changed.log_odds[ours], expected.log_odds[theirs])
    assert (expected.log_odds < 0).sum() > (seen.log_odds < 0).sum()


def test_a_rectangle_has_the_points_and_voxels_of_all_tiles_below_it(store: Submaps) -> None:
    tiles = _tiles(store)
    cloud, voxels = _cloud(tiles), _voxels(tiles)
    rectangle = Rectangle((3.0, -4.0), (14.5, 3.0))
    inside = rectangle.contains(cloud.xyz)
    assert 0 < inside.sum() < len(cloud)
    assert len(tiles.cloud_in(rectangle)) == inside.sum()
    assert len(tiles.voxels_in(rectangle)) == rectangle.contains(voxels.centres_m).sum() > 0
    floors = find_floors(voxels)
    assert len(tiles.floors_in(rectangle)) == rectangle.contains(floors).sum()
    assert len(tiles.cloud_in(Rectangle((600.0, 600.0), (610.0, 610.0)))) == 0


def test_points_and_voxels_that_are_put_in_come_out(store: Submaps) -> None:
    made, filled = _tiles(store), Tiles(CONFIG, T_MAP_WORLD)
    cloud, voxels = _cloud(made), _voxels(made)
    for part in np.array_split(np.arange(len(cloud)), 5):  # in pieces that do not know the tiles
        filled.put_cloud(cloud.select(part))
    for part in np.array_split(np.arange(len(voxels)), 5):
        filled.put_voxels(voxels.select(part))
    np.testing.assert_array_equal(_sorted(_cloud(filled)).xyz, _sorted(cloud).xyz)
    assert {tuple(key) for key in _voxels(filled).keys} == {tuple(key) for key in voxels.keys}
    for tile in filled:
        assert tiles_of(tile.cloud.xyz, filled.edge_m) <= {tile.key}
    # A tile without points takes nothing from the others.
    far = OccupancyVoxels(np.int32([[40, 3, 0]]), np.ones(1, np.float32), filled.resolution_m)
    filled.put_voxels(far)
    assert filled.cloud_in(Rectangle((-1e3, -1e3), (1e3, 1e3))).sigma_m is not None


def tiles_of(xyz: Float32, edge_m: float) -> set[tuple[int, int]]:
    """The tiles in which points lie."""
    return {(int(x), int(y)) for x, y in np.floor(xyz[:, :2] / edge_m)}


def test_corrections_move_the_submaps_apart(store: Submaps) -> None:
    T = np.tile(np.eye(4), (len(store), 1, 1))
    turned = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([30.0, 0.0, 0.0]))
    T[len(store) // 2 :] = turned
    to_right_m = -_cloud(_tiles(store, T)).xyz[:, 1]
    assert ((to_right_m < 3) | (to_right_m > 31)).all()
    assert 0.3 < np.mean(to_right_m < 3) < 0.7


def test_a_path_that_leaves_a_rectangle_and_comes_back_is_in_pieces() -> None:
    path = np.array([[-5, 1, 0], [1, 1, 0], [2, 1, 0], [12, 1, 0], [15, 1, 0], [3, 2, 0]], float)
    inside = Rectangle((0.0, 0.0), (10.0, 10.0)).path(path)
    gap = [np.nan] * 3
    np.testing.assert_array_equal(inside, [[1, 1, 0], [2, 1, 0], gap, [3, 2, 0]])


def test_a_missing_or_foreign_submap_is_one_clear_line(store: Submaps) -> None:
    again, sums = Submaps(store.store), store[1].fused.sums
    assert again.entries == store.entries
    assert [submap.index for submap in again] == list(range(len(again)))
    np.testing.assert_array_equal(again[1].fused.sums, sums)
    assert store.store.cache.nbytes == 0  # submaps are large, and used once
    store.store.delete("submap", (0, 0))
    with pytest.raises(FormatError, match=r"map.*lacks a record"):
        store[0]
    store.store.put("submap", (0, 0), {"a": 1})
    with pytest.raises(FormatError, match="map"):
        store[0]
    store.store.delete("submap_entry", (0, 1))
    with pytest.raises(FormatError, match="submaps of the drive are missing"):
        Submaps(store.store)
