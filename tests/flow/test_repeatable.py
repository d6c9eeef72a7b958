"""The same input gives the same files, whatever the number of threads."""

from __future__ import annotations

from pathlib import Path

import pytest

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene

STREET = StreetScene(frames=4, width_px=320, height_px=120, focal_px=180.0, smooth_edges=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    base = tmp_path_factory.mktemp("runs")
    for threads in (1, 2):
        options = MapOptions(audit=False, out=base / str(threads), threads=threads, mesh=False)
        run_map(SyntheticSource(STREET), load_config(), options)
    return [base / "1", base / "2"]


@pytest.mark.parametrize(
    "name",
    ["trajectory_kitti.txt", "map/cloud.ply", "map/grid.pgm", "map/octomap.ot", "config.yaml"],
)
def test_one_thread_and_two_write_the_same_bytes(runs: list[Path], name: str) -> None:
    assert (runs[0] / name).read_bytes() == (runs[1] / name).read_bytes()
