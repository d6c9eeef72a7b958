"""A memory limit is parsed, divided and enforced; what is measured is that of the process."""

from __future__ import annotations

import platform
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import MemoryLimitError, SettingsError
from recon.core.geometry.se3 import make_transform
from recon.core.values import PointCloud, join_clouds, join_voxels
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.store.records import Store
from recon.map.store.session import Submaps
from recon.map.submaps import SubmapBuilder
from recon.map.tiles import Tiles
from recon.run import threads
from recon.run.machine import peak_memory_mb
from recon.run.threads import MemorySettings, parse_size_mb
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

pytestmark = pytest.mark.usefixtures("blank_figures")
T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
SIZE = {"width_px": 256, "height_px": 96, "focal_px": 150.0}
STREET = StreetScene(frames=12, speed_m_per_frame=0.5, smooth_edges=False, **SIZE)


PRINT_PEAK = "from recon.run.machine import peak_memory_mb; print(peak_memory_mb())"
FREE_AND_RETURN = """
import resource
from pathlib import Path
from recon.run.machine import return_free_memory

def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

blocks = [b"1" * 60_000 for _ in range(2000)]  # smaller than what malloc maps on its own
last = blocks[-1]  # stays behind them, so that they are a gap
blocks.clear()
freed = resident_bytes()
return_free_memory()
print(freed - resident_bytes())
"""


def printed_by(code: str) -> float:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout)


def test_the_peak_is_that_of_the_process_alone_and_stays() -> None:
    ballast = np.ones(100_000_000)  # 800 MB
    peak_mb, below_mb = peak_memory_mb(), printed_by(PRINT_PEAK)
    assert peak_mb > ballast.nbytes / 1e6
    assert 10 < below_mb < 700
    del ballast
    # Linux adds up what each core counted now and then: a few pages more or less.
    assert peak_memory_mb() > 0.99 * peak_mb


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc_trim is glibc's")
def test_what_was_freed_before_something_that_stays_is_returned() -> None:
    assert printed_by(FREE_AND_RETURN) > 100_000_000


@pytest.mark.parametrize(
    ("text", "size_mb"),
    [("2G", 2000), ("1.5 GB", 1500), ("1500M", 1500), ("800mb", 800), ("640", 640)],
)
def test_a_size_is_read_in_its_unit(text: str, size_mb: float) -> None:
    assert parse_size_mb(text) == size_mb


@pytest.mark.parametrize("text", ["", "2T", "-1G", "G", "0", "1e3M", "two"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(SettingsError, match="cannot read this size"):
        parse_size_mb(text)


def test_what_takes_more_than_the_limit_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    free, limited = MemorySettings(), MemorySettings(limit_mb=500)
    assert (free.submap_bytes, free.tile_bytes) == (None, None)
    assert 0 < (limited.submap_bytes or 0) < (limited.tile_bytes or 0) < limited.cache_bytes < 1e8
    monkeypatch.setattr(threads, "peak_memory_mb", lambda: 500.0)
    limited.check("frame 7")
    monkeypatch.setattr(threads, "peak_memory_mb", lambda: 512.0)
    free.check("frame 7")
    with pytest.raises(MemoryLimitError, match=r"^frame 7: .*got 512 MB.*at most 500 MB") as caught:
        limited.check("frame 7")
    assert "\n" not in str(caught.value)


def _along_a_wall(config: ReconConfig) -> Submaps:
    """Twelve frames along a wall, 1 m apart."""
    rng = np.random.default_rng(1)
    store = Submaps(Store.temporary())
    builder = SubmapBuilder(
        config.submaps, config.fusion, config.occupancy, T_MAP_WORLD, config.memory.submap_bytes
    )
    for z in range(12):
        xyz = np.stack(
            [np.full(2000, 2.03), rng.uniform(-1, 1, 2000), rng.uniform(2, 9, 2000)], axis=1
        ).astype(np.float32)
        T = make_transform(np.eye(3), np.array([0.0, 0.0, float(z)]))
        world = PointCloud(xyz + np.float32([0, 0, z]), frame="world")
        builder.integrate(world, PointCloud(xyz), T)
        if builder.full:
            store.add(builder.close())
    store.add(builder.close())
    return store


def test_a_limit_cuts_submaps_and_tiles_smaller_and_the_map_stays_the_same() -> None:
    free, limited = load_config(None, []), load_config(None, ["memory.limit_mb=4"])
    stores = [_along_a_wall(config) for config in (free, limited)]
    assert len(stores[0]) == 1
    assert len(stores[1]) > 3
    maps = [
        # The limit is that of a map alone here: the libraries of the test take more.
        Tiles.of_submaps(
            store, free.model_copy(update={"memory": _Unwatched(limit_mb=limit)}), T_MAP_WORLD
        )
        for store, limit in zip(stores, (None, 4), strict=True)
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


class _Unwatched(MemorySettings):
    """Cuts as a limit does, and never stops."""

    def check(self, where: str) -> None: ...


def test_a_run_stopped_by_its_limit_goes_on_with_a_larger_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peaks = iter([400.0] * 6)
    monkeypatch.setattr(threads, "peak_memory_mb", lambda: next(peaks, 600.0))
    drive, out = tmp_path / "drive", tmp_path / "run"
    write_kitti(SyntheticSource(STREET), drive)
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
    assert run.summary["frames"] == STREET.frames
    assert "limit_mb: 700" in (out / "config.yaml").read_text()
