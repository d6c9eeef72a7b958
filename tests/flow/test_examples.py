"""The examples run as they are."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from recon.sources.synthetic import SyntheticSource
from recon.synthetic.settings import StreetSettings
from tests.scenery.kitti import write_kitti

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def kitti_drive(tmp_path: Path) -> Path:
    """Six frames of the synthetic street as a KITTI folder."""
    folder = tmp_path / "drive"
    write_kitti(SyntheticSource(StreetSettings(frames=6)), folder)
    return folder


def _run(name: str, *arguments: str) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_one_pair_gives_a_cloud(tmp_path: Path) -> None:
    output = _run("01_one_pair.py", str(tmp_path))

    assert "% of the pixels have a disparity" in output
    assert (tmp_path / "cloud.ply").stat().st_size > 0


def test_a_drive_gives_maps(tmp_path: Path, kitti_drive: Path) -> None:
    folder = tmp_path / "run"

    output = _run("02_map_a_drive.py", str(kitti_drive), str(folder))

    assert "position error" in output
    for name in ("trajectory_kitti.txt", "map/cloud.ply", "map/grid.yaml", "map/octomap.bt"):
        assert (folder / name).stat().st_size > 0


def test_every_example_is_tested() -> None:
    tested = Path(__file__).read_text()

    assert [path.name for path in EXAMPLES.glob("*.py") if path.name not in tested] == []
