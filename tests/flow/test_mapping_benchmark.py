"""The benchmark of the mapping runs, and compares maps that are the same."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "mapping.py"


def test_our_rays_and_those_of_octomap_end_in_the_same_cells() -> None:
    command = [sys.executable, str(BENCHMARK), "--json", "--rays", "3000", "--rounds", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["ray_casting"]
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
