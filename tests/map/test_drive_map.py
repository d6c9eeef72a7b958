"""A map assembled tile by tile equals the whole map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import FormatError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import PointCloud
from recon.io.tree_file import read_tree, write_tree
from recon.map import SubmapBuilder
from recon.map.axes import AXES_MAP_WORLD
from recon.map.drive_map import DriveMap
from recon.map.fused_part import join_fused
from recon.map.occupancy_part import join_occupancy
from recon.map.submap_store import SubmapStore
from recon.stereo.cloud import filter_cloud

T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
CONFIG = load_config(None, ["submaps.length_m=4", "submaps.tile_m=6.4", "fusion.min_count=2"])


def _fill(store: SubmapStore, config: ReconConfig = CONFIG) -> SubmapStore:
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
def store(request: pytest.FixtureRequest, tmp_path: Path) -> SubmapStore:
    return _fill(SubmapStore(None if request.param == "memory" else tmp_path))


def _sorted(cloud: PointCloud) -> PointCloud:
    return cloud.select(np.lexsort(cloud.xyz.T))


def test_tiles_of_the_cloud_together_are_the_filtered_whole(store: SubmapStore) -> None:
    tiled = DriveMap(store, CONFIG, T_MAP_WORLD)
    fused = join_fused(submap.fused for submap in store).cloud(0.1, 2)
    whole = filter_cloud(fused, CONFIG.map_filters)
    assert len(list(tiled.cloud_tiles())) >= 4
    assert 0 < len(whole) < len(fused)
    ours, theirs = _sorted(tiled.cloud()), _sorted(whole)
    for name in ("xyz", "normals", "sigma_m", "weight", "count"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_tiles_of_the_occupancy_together_are_the_whole(store: SubmapStore) -> None:
    tiled = DriveMap(store, CONFIG, T_MAP_WORLD).voxels()
    whole = join_occupancy(submap.occupancy for submap in store).voxels(0.2)
    ours, theirs = np.lexsort(tiled.keys.T), np.lexsort(whole.keys.T)
    np.testing.assert_array_equal(tiled.keys[ours], whole.keys[theirs])
    np.testing.assert_array_equal(tiled.log_odds[ours], whole.log_odds[theirs])


def test_an_identity_for_every_submap_changes_nothing(store: SubmapStore) -> None:
    still = np.tile(np.eye(4), (len(store), 1, 1))
    plain, moved = (DriveMap(store, CONFIG, T_MAP_WORLD, T) for T in (None, still))
    np.testing.assert_array_equal(plain.cloud().xyz, moved.cloud().xyz)
    np.testing.assert_array_equal(plain.voxels().log_odds, moved.voxels().log_odds)


def test_corrections_move_the_submaps_apart(store: SubmapStore) -> None:
    T = np.tile(np.eye(4), (len(store), 1, 1))
    turned = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([30.0, 0.0, 0.0]))
    T[len(store) // 2 :] = turned
    cloud = DriveMap(store, CONFIG, T_MAP_WORLD, T).cloud()
    assert ((cloud.xyz[:, 0] < 3) | (cloud.xyz[:, 0] > 31)).all()
    assert 0.3 < np.mean(cloud.xyz[:, 0] < 3) < 0.7


def test_submaps_on_the_disk_are_not_in_memory(tmp_path: Path) -> None:
    store = _fill(SubmapStore(tmp_path, cached=2))
    assert len(store) > 3
    read = [store.get(index) for index in range(len(store))]
    assert [submap.index for submap in read] == list(range(len(store)))
    assert len(store._held) == 2
    assert len(list(tmp_path.iterdir())) == len(store)


def test_a_store_goes_on_from_its_state(tmp_path: Path) -> None:
    store = _fill(SubmapStore(tmp_path))
    again = SubmapStore(tmp_path)
    again.restore(store.state())
    assert again.entries == store.entries
    np.testing.assert_array_equal(again.get(1).fused.sums, store.get(1).fused.sums)


def test_a_damaged_submap_is_one_clear_line(tmp_path: Path) -> None:
    store = _fill(SubmapStore(tmp_path))
    [file, *_] = sorted(tmp_path.iterdir())
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(FormatError, match=file.name):
        store.get(0)


def test_a_tree_comes_back_from_its_file(tmp_path: Path) -> None:
    tree = {
        "array": np.arange(6, dtype=np.int16).reshape(2, 3),
        "none": None,
        "nested": {"nan": float("nan"), "list": [1, "two", np.ones(0)]},
    }
    write_tree(tmp_path / "tree.zip", tree)
    back = read_tree(tmp_path / "tree.zip")
    np.testing.assert_array_equal(back["array"], tree["array"])
    assert back["array"].dtype == np.int16
    assert back["none"] is None
    assert np.isnan(back["nested"]["nan"])
    assert back["nested"]["list"][:2] == [1, "two"]
    assert len(back["nested"]["list"][2]) == 0
