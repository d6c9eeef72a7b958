"""A drive may exceed memory: every layout keeps only a few pairs in memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from recon.core.values import RectifiedCamera, StereoPair
from recon.sources.registry import open_source
from tests.sources import drives

pytest.importorskip("rosbags", reason="extra ros")
from tests.sources.bags import bag

SHORT, LONG, WIDTH_PX, HEIGHT_PX = 50, 100, 320, 240
PAIR_BYTES = 2 * WIDTH_PX * HEIGHT_PX

LAYOUTS: dict[str, drives.Writer] = {
    "kitti": drives.write_kitti,
    "two videos": drives.write_two_videos,
    "ros1": bag(kind="ros1"),
    "ros2": bag(kind="ros2"),
    "mcap": bag(kind="mcap"),
}


@pytest.fixture(scope="module")
def drive() -> tuple[list[StereoPair], RectifiedCamera]:
    """Shifted noise, which compresses badly and so fills a disk."""
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX + LONG + 8), dtype=np.uint8)
    camera = RectifiedCamera(200.0, 159.5, 119.5, 159.5, 0.2, WIDTH_PX, HEIGHT_PX)
    pairs = [
        StereoPair(wide[:, k : k + WIDTH_PX], wide[:, k + 8 : k + 8 + WIDTH_PX], 0.1 * k, k)
        for k in range(LONG)
    ]
    return pairs, camera


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_longer_drive_takes_no_more_memory(
    drive: tuple[list[StereoPair], RectifiedCamera], tmp_path: Path, layout: str
) -> None:
    pairs, camera = drive
    peaks = [
        peak_bytes(LAYOUTS[layout](pairs[:count], camera, tmp_path / str(count)), count)
        for count in (SHORT, LONG)
    ]
    # Times and names are known of every pair; a recording is read in chunks of a megabyte.
    assert peaks[1] - peaks[0] < 2000 * (LONG - SHORT)
    assert PAIR_BYTES < peaks[1] < 0.5 * LONG * PAIR_BYTES


def peak_bytes(path: Path, count: int) -> int:
    tracemalloc.start()
    try:
        assert sum(1 for _ in open_source(path)) == count
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
