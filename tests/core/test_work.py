"""What overlaps gives the same results in the same order; a memory limit is kept."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.commands.config import ReconConfig, load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core import work as work_file
from recon.core.errors import MemoryLimitError, SettingsError
from recon.core.geometry.se3 import make_transform
from recon.core.machine import available_cores, parse_size_mb, peak_memory_mb
from recon.core.values import PointCloud, join_clouds, join_voxels
from recon.core.work import OneBehind, look_ahead, side_by_side, use_threads
from recon.map import settings as memory_file
from recon.map.drive.mapper import SubmapBuilder
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.settings import MemorySettings
from recon.map.store.records import Store
from recon.map.store.session import Submaps
from recon.map.tiles import Tiles
from tests.run.pools import observed_pool
from tests.scenery.kitti import street_drive
from tests.scenery.patience import LONG_S


@given(st.lists(st.integers()), st.integers(min_value=1, max_value=5))
def test_results_come_in_order(items, count):
    after = [x + 1 for x in items]
    assert list(look_ahead(lambda x: x + 1, items, depth=count)) == after
    assert list(side_by_side(lambda x: x + 1, items, threads=count)) == after


def test_as_many_items_are_worked_on_as_there_are_threads_and_threads_as_cores():
    # Each waits for the other: one thread alone would wait for ever.
    both = threading.Barrier(2, timeout=LONG_S)

    def meet(item: int) -> int:
        both.wait()
        return item

    assert list(side_by_side(meet, range(4), threads=2)) == [0, 1, 2, 3]
    cores, before = available_cores(), cv2.getNumThreads()
    assert [use_threads(1), use_threads(None), use_threads(cores + 3)] == [1, cores, cores]
    cv2.setNumThreads(before)


@pytest.mark.parametrize(
    ("ahead", "most"), [(partial(look_ahead, depth=3), 5), (partial(side_by_side, threads=2), 3)]
)
def test_no_more_items_are_begun_than_can_be_held(ahead, most):
    begun: list[int] = []

    def items() -> Iterator[int]:
        for item in range(100):
            begun.append(item)
            yield item

    results = ahead(lambda x: x, items())
    assert next(results) == 0
    results.close()  # type: ignore[attr-defined]
    assert 1 < len(begun) <= most


def test_nothing_is_begun_after_an_interruption(monkeypatch):
    begun, first, (pool, dropped) = list[int](), threading.Event(), observed_pool()

    def work(item: int) -> None:
        begun.append(item)
        first.set()
        dropped.wait(LONG_S)

    def interrupted(_: Future[None]) -> None:
        first.wait(LONG_S)
        raise KeyboardInterrupt

    monkeypatch.setattr(work_file, "ThreadPoolExecutor", pool)
    monkeypatch.setattr(Future, "result", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(side_by_side(work, range(100), threads=1))
    assert begun == [0]


def test_an_error_of_an_item_or_of_the_source_is_raised_at_its_turn():
    def items() -> Iterator[str]:
        yield from ("0", "1")
        raise OSError("disk gone")

    for ahead in (look_ahead, partial(side_by_side, threads=2)):
        results = ahead(int, ["0", "1", "no number", "3"])
        assert [next(results), next(results)] == [0, 1]
        with pytest.raises(ValueError, match="no number"):
            next(results)
    results = look_ahead(int, items())
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(OSError, match="disk gone"):
        next(results)


def test_jobs_behind_are_done_in_order_one_at_a_time():
    behind, gate, done = OneBehind(), threading.Event(), list[int]()

    def first() -> None:
        gate.wait(LONG_S)
        done.append(-1)

    behind.begin(first)
    assert done == []
    threading.Timer(0.05, gate.set).start()
    for item in range(50):
        behind.begin(partial(done.append, item))
        assert done[: item + 1] == list(range(-1, item))
    behind.abandon()
    assert done == list(range(-1, 50))
    behind = OneBehind()  # whose errors are raised once, and not when it is abandoned
    behind.begin(partial(int, "no number"))
    with pytest.raises(ValueError, match="no number"):
        behind.wait()
    behind.wait()
    behind.begin(partial(int, "no number"))
    behind.abandon()


T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))


def test_the_peak_is_that_of_the_process_alone_and_stays():
    ballast = np.ones(100_000_000)  # 800 MB
    code = "from recon.core.machine import peak_memory_mb; print(peak_memory_mb())"
    below_mb = float(subprocess.check_output([sys.executable, "-c", code], text=True))
    peak_mb = peak_memory_mb()
    assert peak_mb > ballast.nbytes / 1e6
    assert 10 < below_mb < 700
    del ballast
    # Linux adds up what each core counted now and then: a few pages more or less.
    assert peak_memory_mb() > 0.99 * peak_mb


def test_a_size_is_read_in_its_unit_and_what_takes_more_than_the_limit_is_one_line(monkeypatch):
    sizes_mb = {"2G": 2000, "1.5 GB": 1500, "1500M": 1500, "800mb": 800, "640": 640}
    assert {text: parse_size_mb(text) for text in sizes_mb} == sizes_mb
    for text in ("", "2T", "-1G", "G", "0", "1e3M", "two"):
        with pytest.raises(SettingsError, match="cannot read this size"):
            parse_size_mb(text)
    free, limited = MemorySettings(), MemorySettings(limit_mb=500)
    assert (free.submap_bytes, free.tile_bytes) == (None, None)
    assert 0 < (limited.submap_bytes or 0) < (limited.tile_bytes or 0) < limited.cache_bytes < 1e8
    monkeypatch.setattr(memory_file, "peak_memory_mb", lambda: 500.0)
    limited.check("frame 7")
    monkeypatch.setattr(memory_file, "peak_memory_mb", lambda: 512.0)
    free.check("frame 7")
    with pytest.raises(MemoryLimitError, match=r"^frame 7: .*got 512 MB.*at most 500 MB") as caught:
        limited.check("frame 7")
    assert "\n" not in str(caught.value)


def _along_a_wall(config: ReconConfig) -> Submaps:
    """Twelve frames along a wall, 1 m apart."""
    rng, store = np.random.default_rng(1), Submaps(Store.temporary())
    settings = (config.submaps, config.fusion, config.occupancy)
    builder = SubmapBuilder(*settings, T_MAP_WORLD, config.memory.submap_bytes)
    for z in range(12):
        xyz = rng.uniform((2.03, -1, 2), (2.03, 1, 9), (2000, 3)).astype(np.float32)
        T = make_transform(np.eye(3), np.array([0.0, 0.0, float(z)]))
        world = PointCloud(xyz + np.float32([0, 0, z]), frame="world")
        builder.integrate(world, PointCloud(xyz), T)
        if builder.full:
            store.add(builder.close())
    store.add(builder.close())
    return store


def test_a_limit_cuts_submaps_and_tiles_smaller_and_the_map_stays_the_same(monkeypatch):
    free, limited = load_config(None, []), load_config(None, ["memory.limit_mb=4"])
    stores = [_along_a_wall(config) for config in (free, limited)]
    assert len(stores[0]) == 1
    assert len(stores[1]) > 3
    # The limit is that of a map alone here: the libraries of the test take more.
    monkeypatch.setattr(memory_file, "peak_memory_mb", lambda: 0.0)
    maps = [
        Tiles.of_submaps(store, config, T_MAP_WORLD)
        for store, config in zip(stores, (free, limited), strict=True)
    ]
    assert maps[1].edge_cells < maps[0].edge_cells
    whole, cut = (join_clouds(tile.cloud for tile in tiles) for tiles in maps)
    assert len(whole) == len(cut) > 1000
    voxel_m = free.fusion.voxel_m
    order, other = (np.lexsort(np.floor(cloud.xyz / voxel_m).T) for cloud in (whole, cut))
    # Sums of single precision in another order, and rounded.
    np.testing.assert_allclose(whole.xyz[order], cut.xyz[other], atol=2e-5)
    whole_voxels, cut_voxels = (
        join_voxels((tile.voxels for tile in tiles), tiles.resolution_m) for tiles in maps
    )
    assert len(whole_voxels) == len(cut_voxels) > 1000
    order, other = np.lexsort(whole_voxels.keys.T), np.lexsort(cut_voxels.keys.T)
    np.testing.assert_array_equal(whole_voxels.keys[order], cut_voxels.keys[other])
    np.testing.assert_allclose(whole_voxels.log_odds[order], cut_voxels.log_odds[other], atol=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_a_run_stopped_by_its_limit_goes_on_with_a_larger_one(tmp_path, monkeypatch):
    peaks = iter([400.0] * 6)
    monkeypatch.setattr(memory_file, "peak_memory_mb", lambda: next(peaks, 600.0))
    drive, out = street_drive(tmp_path / "drive", 12, speed_m_per_frame=0.5), tmp_path / "run"
    overrides = ["checkpoints.every_frames=4", "submaps.length_m=4", "memory.limit_mb=500"]
    config = load_config(None, overrides)
    source, options = MapOptions(source=drive, mesh=False).open(config)
    options = replace(options, audit=False, out=out)
    with pytest.raises(MemoryLimitError, match=r"got 600 MB.*--resume .* larger --memory-limit"):
        run_map(source, config, options)
    options, config = MapOptions(mesh=False).resumed(out, None, [{"memory.limit_mb": 700}])
    assert (config.memory.limit_mb, config.submaps.length_m) == (700, 4)
    assert options.source == str(drive)
    run = run_map(source, config, replace(options, audit=False))
    assert run.summary.to_json()["frames"] == 12
    assert "limit_mb: 700" in (out / "config.yaml").read_text()
