"""Summaries contain only valid JSON values, and list the lost frames."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon.odometry.health import doubt_about, health_warnings, stretches
from recon.odometry.protocol import OdometryHealth
from recon.run.run import Run, plain


@dataclass(frozen=True)
class Figures:
    error: float
    bad: dict[float, float]
    lengths: tuple[float, ...]


def test_plain_values_survive_json_and_nan_becomes_null() -> None:
    figures = Figures(error=math.nan, bad={0.5: 1.25, 2.0: math.inf}, lengths=(50.0, 100.0))
    expected = {"error": None, "bad": {"0.5": 1.25, "2.0": None}, "lengths": [50.0, 100.0]}
    assert json.loads(json.dumps(plain(figures), allow_nan=False)) == expected


def test_lost_frames_are_named_by_stretches() -> None:
    good, lost = OdometryHealth(), OdometryHealth(ok=False, notes=("dark",))
    lines = health_warnings([good, lost, lost, good, lost, *[good] * 30])
    assert [line.split(":")[0] for line in lines] == ["frames 1-2", "frame 4"]
    assert all("dark" in line for line in lines)


def test_a_drive_with_many_lost_frames_is_called_what_it_is_first() -> None:
    good, lost = OdometryHealth(), OdometryHealth(ok=False, notes=("dark",))
    first, *others = health_warnings([good, *[lost] * 3, *[good] * 16])
    assert first.startswith("PATH AND MAP ARE NOT TO BE TRUSTED")
    assert "3 of 20 frames" in first
    assert len(others) == 1


def test_what_follows_a_lost_pose_is_another_stretch_unless_that_was_skipped() -> None:
    good, lost = OdometryHealth(), OdometryHealth(ok=False)
    skipped = OdometryHealth(ok=False, skipped=True)
    assert stretches([good, skipped, good, lost, good, good]).tolist() == [0, -1, 0, -1, 1, 1]
    assert stretches([good, lost, skipped, good]).tolist() == [0, -1, -1, 1]
    assert stretches([]).tolist() == []


def test_one_line_says_what_is_doubted_of_a_drive() -> None:
    good, lost = OdometryHealth(), OdometryHealth(ok=False)
    skipped = OdometryHealth(ok=False, skipped=True)
    assert doubt_about([good] * 3) == []
    (line,) = doubt_about([*[good] * 20, skipped, *[good] * 20])
    assert line == "1 of 41 poses are not to be trusted (frame 20): nothing of them is in the map"
    (line,) = doubt_about([*[good] * 20, lost, *[good] * 20])
    assert line.endswith("and what follows may be misplaced")
    (line,) = doubt_about([good, lost, good])
    assert line.startswith("PATH AND MAP ARE NOT TO BE TRUSTED: the poses of 1 of 3 frames")


def test_a_healthy_drive_has_no_warning() -> None:
    assert health_warnings([OdometryHealth()] * 3) == []


def test_cost_sums_the_parts_of_a_stage(tmp_path: Path) -> None:
    figures: dict[str, Any] = {}
    with Run("map", tmp_path / "run") as run:
        for _ in range(2):
            with run.stage("match"):
                time.sleep(0.01)
        run.finish(figures, source="", inputs=[])
    assert list(figures["stages"]) == ["match"]
    assert figures["seconds"] >= figures["stages"]["match"] >= 0.02
    assert 10 < figures["peak_memory_mb"] < 100_000


def test_what_is_wrong_with_frames_is_reported_once() -> None:
    good, warned = OdometryHealth(), OdometryHealth(warnings=("rows are off",))
    lines = health_warnings([warned, good, warned, good])
    assert lines == ["frames 0-2: rows are off"]
