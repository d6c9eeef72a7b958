"""A map assembled tile by tile equals the whole map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import FormatError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import PointCloud
from recon.map import Store, SubmapBuilder
from recon.map.axes import AXES_MAP_WORLD
from recon.map.drive_map import DriveMap
from recon.map.fused_part import join_fused
from recon.map.occupancy_part import join_occupancy
from recon.map.submap_records import Submaps
from recon.stereo.cloud import filter_cloud

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


def _sorted(cloud: PointCloud) -> PointCloud:
    return cloud.select(np.lexsort(cloud.xyz.T))


def test_tiles_of_the_cloud_together_are_the_filtered_whole(store: Submaps) -> None:
    tiled = DriveMap(store, CONFIG, T_MAP_WORLD)
    fused = join_fused(submap.fused for submap in store).cloud(0.1, 2)
    whole = filter_cloud(fused, CONFIG.map_filters)
    assert len(list(tiled.cloud_tiles())) >= 4
    assert 0 < len(whole) < len(fused)
    ours, theirs = _sorted(tiled.cloud()), _sorted(whole)
    for name in ("xyz", "normals", "sigma_m", "weight", "count"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_tiles_of_the_occupancy_together_are_the_whole(store: Submaps) -> None:
    tiled = DriveMap(store, CONFIG, T_MAP_WORLD).voxels()
    whole = join_occupancy(submap.occupancy for submap in store).voxels(0.2)
    ours, theirs = np.lexsort(tiled.keys.T), np.lexsort(whole.keys.T)
    np.testing.assert_array_equal(tiled.keys[ours], whole.keys[theirs])
    np.testing.assert_array_equal(tiled.log_odds[ours], whole.log_odds[theirs])


def test_an_identity_for_every_submap_changes_nothing(store: Submaps) -> None:
    still = np.tile(np.eye(4), (len(store), 1, 1))
    plain, moved = (DriveMap(store, CONFIG, T_MAP_WORLD, T) for T in (None, still))
    np.testing.assert_array_equal(plain.cloud().xyz, moved.cloud().xyz)
    np.testing.assert_array_equal(plain.voxels().log_odds, moved.voxels().log_odds)


def test_corrections_move_the_submaps_apart(store: Submaps) -> None:
    T = np.tile(np.eye(4), (len(store), 1, 1))
    turned = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([30.0, 0.0, 0.0]))
    T[len(store) // 2 :] = turned
    cloud = DriveMap(store, CONFIG, T_MAP_WORLD, T).cloud()
    assert ((cloud.xyz[:, 0] < 3) | (cloud.xyz[:, 0] > 31)).all()
    assert 0.3 < np.mean(cloud.xyz[:, 0] < 3) < 0.7


def test_a_map_of_the_disk_does_not_fill_the_memory(tmp_path: Path) -> None:
    submaps = _fill(Submaps(Store.create(tmp_path / "map.recon", cache_bytes=1_000_000)))
    assert len(submaps) > 3
    read = [submaps.get(index) for index in range(len(submaps))]
    assert [submap.index for submap in read] == list(range(len(submaps)))
    assert 0 < submaps.store.cache.nbytes < 1_000_000
    assert submaps.get(len(submaps) - 1) is read[-1]


def test_submaps_are_found_again(tmp_path: Path) -> None:
    with Store.create(tmp_path / "map.recon") as store:
        submaps = _fill(Submaps(store))
        store.commit()
        entries, sums = submaps.entries, submaps.get(1).fused.sums
    with Store.open(tmp_path / "map.recon", read_only=True) as store:
        again = Submaps(store)
        assert again.entries == entries
        np.testing.assert_array_equal(again.get(1).fused.sums, sums)


def test_a_missing_or_foreign_submap_is_one_clear_line(store: Submaps) -> None:
    store.store.delete("submap", (0, 0))
    with pytest.raises(FormatError, match=r"map.*lacks a record"):
        store.get(0)
    store.store.put("submap", (0, 0), {"a": 1})
    with pytest.raises(FormatError, match="map"):
        store.get(0)
    store.store.delete("submap_entry", (0, 1))
    with pytest.raises(FormatError, match="submaps of the drive are missing"):
        Submaps(store.store)
