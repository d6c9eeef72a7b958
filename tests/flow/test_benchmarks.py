"""Benchmarks run; memory does not grow with the length of a drive, and stays within its limit."""

import json
import runpy
import subprocess
import sys
from typing import Any

import pytest

from recon.sources.registry import open_source
from tests.flow.runs import RECON, ROOT
from tests.scenery.kitti import street_drive
from tests.scenery.year import FIRST_S, WEEK_S, WeekDrive

BENCHMARKS = ROOT / "benchmarks"
LIMIT_MB = 750


def test_the_budget_of_a_drive_names_every_stage_and_rays_are_cast(tmp_path, monkeypatch, capsys):
    street, program = (
        street_drive(tmp_path, 4, speed_m_per_frame=0.4),
        str(BENCHMARKS / "mapping.py"),
    )
    options = ["--json", "--rays", "3000", "--rounds", "1", "--drive", str(street)]
    monkeypatch.setattr(sys, "argv", [program, *options])
    monkeypatch.syspath_prepend(BENCHMARKS)
    runpy.run_path(program, run_name="__main__")
    result = json.loads(capsys.readouterr().out)
    drive = result["drive"]
    assert drive["frames"] == 4
    # Two digits of one are printed, and one of the other.
    assert drive["fps"] == pytest.approx(1e3 / drive["frame_ms"], rel=0.01, abs=0.006)
    assert {"match", "back_project", "odometry", "map", "loops"} <= set(drive["stages_ms"])
    assert {"cloud", "octomap", "grid", "mesh", "report"} <= set(drive["after_s"])
    rows = [(row["scene"], row["resolution_m"]) for row in result["ray_casting"]]
    assert rows == [(scene, m) for scene in ("street", "scattered") for m in (0.2, 0.1)]
    # Every stage of the run is in one of the two; the whole holds those after the last frame.
    assert sum(drive["after_s"].values()) < drive["whole_run_s"]


def printed_by(*command: object) -> dict[str, Any]:
    words = [*map(str, command), "--json"]
    done = subprocess.run(words, capture_output=True, check=False, text=True)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.slow
def test_a_limit_is_held_and_the_map_is_the_same(tmp_path):
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
def test_a_drive_twice_as_long_takes_hardly_more_memory():
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


def test_a_week_of_the_year_is_a_drive_that_maps_read(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    year = runpy.run_path(str(BENCHMARKS / "year.py"))
    monkeypatch.setitem(year["write_drive"].__globals__, "FRAMES", 2)
    source = open_source(year["write_drive"](3, tmp_path / "03"))
    first, second = source.frames()
    assert first.timestamp_s == FIRST_S + 3 * WEEK_S
    assert first.left.shape == second.right.shape == (208, 512, 3)
    rendered = WeekDrive(3).calibration
    assert source.calibration.baseline_m == pytest.approx(rendered.baseline_m)
    assert source.calibration.focal_px == pytest.approx(rendered.focal_px)
