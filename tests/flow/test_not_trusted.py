"""What a run did not trust is said by every later command, and can be left out of a joined map."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from recon.commands.config import load_config
from recon.commands.evaluate import run_evaluate_map, run_evaluate_trajectory
from recon.commands.export import run_export, run_mesh, run_occupancy
from recon.commands.localize import run_localize
from recon.commands.map_options import MapOptions
from recon.commands.merge import run_merge, run_remove
from recon.core.values import RectifiedPair
from recon.evaluation.trajectory import TrajectoryRules
from recon.sources.registry import open_source
from tests.flow.test_failing_drives import ROAD, Road, doubted, map_drive


@pytest.fixture(scope="module")
def seen() -> list[RectifiedPair]:
    """Ten frames of a road with texture."""
    return ROAD.pairs(range(10))


def _said(summary: dict[str, Any], out: Path) -> str:
    """The first warning of a run, which its record has, too."""
    assert summary["warnings"] == json.loads((out / "summary.json").read_text())["warnings"]
    return str(summary["warnings"][0])


@pytest.fixture(scope="module")
def runs(seen: list[RectifiedPair], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that ends on a bare road, and one that does not, of the same road."""
    root = tmp_path_factory.mktemp("runs")
    bare = [Road(grain=1.0, step_m=2.8).pair(index) for index in range(10, 14)]
    for folder, pairs in (("bad", [*seen[:8], *bare]), ("good", seen[4:])):
        (root / folder).mkdir()
        map_drive(pairs, root / folder)
    return root


def test_every_later_command_says_that_poses_were_not_to_be_trusted(
    runs: Path, tmp_path: Path
) -> None:
    bad, good = runs / "bad" / "out", runs / "good" / "out"
    cloud, truth = good / "map" / "cloud.ply", good / "trajectory_tum.txt"
    names = ("export", "mesh", "occupancy", "found")
    out = {name: tmp_path / name for name in names}
    alone = [
        _said(run_export(bad, products=["cloud", "grid"], out=out["export"]), out["export"]),
        _said(run_occupancy(bad, out=out["occupancy"]), out["occupancy"]),
        _said(run_mesh(bad, load_config(), out=out["mesh"]), out["mesh"]),
        # A run without a map of its own knows it from the run that it was made from.
        run_evaluate_map(out["export"], cloud)["warnings"][0],
        run_evaluate_map(bad, cloud)["warnings"][0],
        run_evaluate_trajectory(bad / "trajectory_tum.txt", truth, TrajectoryRules())["warnings"][
            0
        ],
    ]
    drive = open_source(runs / "good" / "drive")
    options = MapOptions("localize", out["found"])
    alone.append(_said(run_localize(drive, bad, options=options).summary, out["found"]))
    for line in alone:
        assert line.startswith("PATH AND MAP ARE NOT TO BE TRUSTED: the poses of 4 of 12")


def test_a_merged_map_says_which_of_its_drives_is_not_to_be_trusted(
    runs: Path, tmp_path: Path
) -> None:
    out, parts = tmp_path / "merged", [runs / name / "out" for name in ("good", "bad")]
    merged = run_merge(parts, options=MapOptions("merge", out, mesh=False))
    assert _said(merged, out).startswith("session 1 (drive): PATH AND MAP ARE NOT TO BE")
    assert [one["frames_not_trusted"] for one in merged["sessions"]] == [0, 4]
    assert [one["frames_placed"] for one in merged["sessions"]] == [6, 8]
    assert "PATH AND MAP ARE NOT TO BE TRUSTED" in (out / "report.html").read_text()
    after = run_remove(out, 0, None, MapOptions(mesh=False))
    assert after["warnings"][0].startswith("PATH AND MAP ARE NOT TO BE TRUSTED")


def test_where_nothing_says_how_a_drive_went_on_another_submap_begins(
    seen: list[RectifiedPair], tmp_path: Path
) -> None:
    dark = replace(seen[2], left=0 * seen[2].left, right=0 * seen[2].right)
    run = map_drive([*seen[:2], dark, *seen[3:6], *ROAD.pairs(range(60, 64))], tmp_path)
    health = run.mapped.health
    assert doubted(run) == [2, 6]
    assert [health[n].skipped for n in (2, 6)] == [True, False]
    assert [entry.first_frame for entry in run.mapped.session.submaps.entries] == [0, 7]
