"""The examples run as they are."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def kitti_drive(tmp_path: Path) -> Path:
    """Six frames of the synthetic street as a KITTI folder."""
    folder = tmp_path / "drive"
    street = StreetScene(frames=6, width_px=256, height_px=96, focal_px=150.0, smooth_edges=False)
    write_kitti(SyntheticSource(street), folder)
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run an example as the program that it is; what it prints."""

    def run_example(name: str, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run_example


def test_one_pair_gives_a_cloud(run: Callable[..., str], tmp_path: Path) -> None:
    output = run("01_one_pair.py", str(tmp_path))

    assert "% of the pixels have a disparity" in output
    assert (tmp_path / "cloud.ply").stat().st_size > 0


def test_a_drive_gives_maps(run: Callable[..., str], tmp_path: Path, kitti_drive: Path) -> None:
    folder = tmp_path / "run"

    output = run("02_map_a_drive.py", str(kitti_drive), str(folder))

    assert "position error" in output
    for name in ("trajectory_kitti.txt", "map/cloud.ply", "map/grid.yaml", "map/octomap.bt"):
        assert (folder / name).stat().st_size > 0


def test_every_example_is_tested() -> None:
    tested = Path(__file__).read_text()

    assert [path.name for path in EXAMPLES.glob("*.py") if path.name not in tested] == []
