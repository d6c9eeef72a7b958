"""The mapping benchmark runs, and compares equal maps."""

from __future__ import annotations

import contextlib
import io
import json
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "mapping.py"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the benchmark prints."""
    drive = tmp_path_factory.mktemp("drive")
    street = StreetScene(
        frames=4,
        width_px=256,
        height_px=96,
        focal_px=150.0,
        speed_m_per_frame=0.4,
        smooth_edges=False,
    )
    write_kitti(SyntheticSource(street), drive)
    options = ["--json", "--rays", "3000", "--rounds", "1", "--drive", str(drive)]
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", [str(BENCHMARK), *options])
        patch.syspath_prepend(BENCHMARK.parent)
        runpy.run_path(str(BENCHMARK), run_name="__main__")
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
        ("street", 0.2),
        ("street", 0.1),
        ("scattered", 0.2),
        ("scattered", 0.1),
    ]
    for row in rows:
        same = row["agreement"]
        assert same["occupied"] == 1.0
        # OctoMap's rays are of single precision: close to edges they take other cells.
        assert same["free"] > 0.98
        assert same["occupied_cells"] > 500
        assert min(row["ms"].values()) > 0
