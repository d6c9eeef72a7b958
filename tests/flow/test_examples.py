"""The examples run as they are."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from tests.flow.runs import ROOT
from tests.scenery.kitti import street_drive

EXAMPLES = {
    "01_one_pair.py": ("% of the pixels have a disparity", ["cloud.ply"]),
    "02_map_a_drive.py": (
        "position error",
        ["trajectory_kitti.txt", "map/cloud.ply", "map/grid.yaml", "map/octomap.bt"],
    ),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_prints_and_writes_what_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said, files = EXAMPLES[name]
    words = [str(tmp_path / "out")]
    if "drive" in name:
        words.insert(0, str(street_drive(tmp_path / "drive", 6)))
    monkeypatch.setattr(sys, "argv", [name, *words])
    runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    assert said in capsys.readouterr().out
    assert all((tmp_path / "out" / file).stat().st_size > 0 for file in files)


def test_every_example_is_tested() -> None:
    assert {path.name for path in (ROOT / "examples").glob("*.py")} == EXAMPLES.keys()
