"""Memory does not grow with the length of a drive, and stays within its limit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

STREET = StreetScene(
    frames=100,
    width_px=320,
    height_px=120,
    focal_px=182.4,
    speed_m_per_frame=0.5,
    path="straight",
    repeat_m=50.0,
    sway=0.0,
)
#: A map so fine that it is most of what a run takes.
FINE = ["--set", "fusion.voxel_m=0.03", "--set", "occupancy.resolution_m=0.06"]
LIMIT_MB = 750
BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "memory.py"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(SyntheticSource(STREET), folder)
    # Compiling the kernels takes more memory than any later run does.
    _summary(_map(folder, tmp_path_factory.mktemp("compiled")))
    return folder


def _map(drive: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "recon", "map", str(drive), "--out", str(out), "--no-mesh"]
    return subprocess.run(
        [*command, *FINE, *options, "--json", "--quiet"],
        capture_output=True,
        text=True,
        check=False,
    )


def _summary(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.slow
def test_a_limit_is_held_and_the_map_is_the_same(drive: Path, tmp_path: Path) -> None:
    free = _summary(_map(drive, tmp_path / "free"))
    limited = _summary(_map(drive, tmp_path / "limited", "--memory-limit", f"{LIMIT_MB}M"))
    assert free["peak_memory_mb"] > LIMIT_MB + 100
    assert limited["peak_memory_mb"] <= LIMIT_MB
    assert limited["voxels"] == free["voxels"] > 1_000_000
    # Weights of voxels are sums of single precision, and a few lie at the edge of a filter.
    assert limited["points"] == pytest.approx(free["points"], rel=1e-3)


@pytest.mark.slow
def test_a_limit_that_cannot_be_held_is_one_line_and_the_run_can_be_resumed(
    drive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    done = _map(drive, out, "--memory-limit", "200M")
    assert done.returncode == 1
    assert done.stdout == ""
    [line] = done.stderr.splitlines()
    assert line.startswith("error: frame 0: the memory limit cannot be kept (got ")
    assert f"recon map --resume {out} goes on from there with a larger --memory-limit" in line
    resume = ["map", "--resume", str(out), "--memory-limit", f"{LIMIT_MB}M", "--json", "--quiet"]
    resumed = subprocess.run(
        [sys.executable, "-m", "recon", *resume], capture_output=True, text=True, check=False
    )
    summary = _summary(resumed)
    assert summary["frames"] == STREET.frames
    assert summary["peak_memory_mb"] <= LIMIT_MB


@pytest.mark.slow
def test_a_drive_twice_as_long_takes_hardly_more_memory() -> None:
    command = [sys.executable, str(BENCHMARK), "--json", "--width", "192"]
    command += ["--again", "mesh", "--again", "occupancy"]
    # What is kept of submaps and of places is full after some 500 frames.
    done = subprocess.run(
        [*command, "--frames", "600", "--frames", "1200"],
        capture_output=True,
        text=True,
        check=False,
    )
    found = _summary(done)
    short, long = found["drives"]
    assert long["voxels"] > 1.9 * short["voxels"]
    assert long["peak_mb"] / short["peak_mb"] < 1.1
    # Of more tiles the fullest ones that are meshed side by side are fuller: 1.15 times at 4 times
    # the length. What is read as a whole would double.
    for name, most in (("mesh", 1.25), ("occupancy", 1.1)):
        peaks_mb = [row["again"][name]["peak_mb"] for row in (long, short)]
        assert peaks_mb[0] / peaks_mb[1] < most
