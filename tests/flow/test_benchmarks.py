"""Benchmarks run; memory does not grow with the length of a drive, and stays within its limit."""

from __future__ import annotations

import contextlib
import io
import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.flow.runs import RECON, ROOT
from tests.scenery.kitti import street_drive

BENCHMARKS = ROOT / "benchmarks"
LIMIT_MB = 750


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the benchmark of mapping prints."""
    drive = street_drive(tmp_path_factory.mktemp("drive"), 4, speed_m_per_frame=0.4)
    program = str(BENCHMARKS / "mapping.py")
    options = ["--json", "--rays", "3000", "--rounds", "1", "--drive", str(drive)]
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", [program, *options])
        patch.syspath_prepend(BENCHMARKS)
        runpy.run_path(program, run_name="__main__")
    return json.loads(printed.getvalue())


def test_the_budget_of_a_drive_names_every_stage(result: dict[str, Any]) -> None:
    drive = result["drive"]
    assert drive["frames"] == 4
    # Two digits of one are printed, and one of the other.
    assert drive["fps"] == pytest.approx(1e3 / drive["frame_ms"], rel=0.01, abs=0.006)
    assert {"match", "back_project", "odometry", "map", "loops"} <= set(drive["stages_ms"])
    assert {"cloud", "octomap", "grid", "mesh", "report"} <= set(drive["after_s"])
    # Every stage of the run is in one of the two; the whole holds those after the last frame.
    assert sum(drive["after_s"].values()) < drive["whole_run_s"]


def test_our_rays_and_those_of_octomap_end_in_the_same_cells(result: dict[str, Any]) -> None:
    rows = result["ray_casting"]
    assert [(row["scene"], row["resolution_m"]) for row in rows] == [
        (scene, resolution_m) for scene in ("street", "scattered") for resolution_m in (0.2, 0.1)
    ]
    for row in rows:
        same = row["agreement"]
        assert same["occupied"] == 1.0
        # OctoMap's rays are of single precision: close to edges they take other cells.
        assert same["free"] > 0.98
        assert same["occupied_cells"] > 500
        assert min(row["ms"].values()) > 0


def printed_by(*command: object) -> dict[str, Any]:
    words = [*map(str, command), "--json"]
    done = subprocess.run(words, capture_output=True, check=False, text=True)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.slow
def test_a_limit_is_held_and_the_map_is_the_same(tmp_path: Path) -> None:
    street = {"speed_m_per_frame": 0.5, "path": "straight", "repeat_m": 50.0, "sway": 0.0}
    drive = street_drive(tmp_path / "drive", 100, 320, smooth_edges=True, **street)
    # A map so fine that it is most of what a run takes.
    fine = ("--set=fusion.voxel_m=0.03", "--set=occupancy.resolution_m=0.06", "--no-mesh")
    command = (*RECON, "map", drive, *fine, "--quiet", "--out")
    # Compiling the kernels takes more memory than any later run does.
    printed_by(*command, tmp_path / "compiled")
    free = printed_by(*command, tmp_path / "free")
    limited = printed_by(*command, tmp_path / "limited", "--memory-limit", f"{LIMIT_MB}M")
    assert free["peak_memory_mb"] > LIMIT_MB + 100
    assert limited["peak_memory_mb"] <= LIMIT_MB
    assert limited["voxels"] == free["voxels"] > 1_000_000
    # Weights of voxels are sums of single precision, and a few lie at the edge of a filter.
    assert limited["points"] == pytest.approx(free["points"], rel=1e-3)


@pytest.mark.slow
def test_a_drive_twice_as_long_takes_hardly_more_memory() -> None:
    command = (sys.executable, BENCHMARKS / "memory.py", "--width", "192")
    again = ("--again", "mesh", "--again", "occupancy")
    # What is kept of submaps and of places is full after some 500 frames.
    short, long = printed_by(*command, *again, "--frames", "600", "--frames", "1200")["drives"]
    assert long["voxels"] > 1.9 * short["voxels"]
    assert long["peak_mb"] / short["peak_mb"] < 1.1
    # Of more tiles the fullest ones that are meshed side by side are fuller: 1.15 times at 4 times
    # the length. What is read as a whole would double.
    for name, most in (("mesh", 1.25), ("occupancy", 1.1)):
        peaks_mb = [row["again"][name]["peak_mb"] for row in (long, short)]
        assert peaks_mb[0] / peaks_mb[1] < most
