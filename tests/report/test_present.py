from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from recon.commands.config import ReconConfig
from recon.core.values import (
    Disparity,
    OccupancyGrid,
    PointCloud,
    Reason,
    RectifiedPair,
    Trajectory,
)
from recon.core.values.arrays import Float64
from recon.report.colour import REASON_COLOURS
from recon.report.present import command_line, present_disparity, present_map, present_pair
from recon.run.directory import RunDirectory


@pytest.fixture
def pair_run(pair: RectifiedPair, disparity: Disparity, cloud: PointCloud) -> SimpleNamespace:
    return SimpleNamespace(
        name="scenes/bike/im0.png",
        config=ReconConfig(),
        pair=pair,
        disparity=disparity,
        cloud=cloud,
        mesh=None,
        truth=None,
        metrics=None,
        summary={"points": 2000},
        warnings=("a warning",),
    )


def test_pair_leaves_its_report_and_pictures_in_colour(
    pair_run: SimpleNamespace, tmp_path: Path
) -> None:
    with RunDirectory(tmp_path / "run") as directory:
        present_pair(pair_run, directory)  # type: ignore[arg-type]
        directory.write_json("run.json", {})
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Stereo pair im0.png" in page
    assert "a warning" in page
    assert "rectification:" in page  # the configuration


def test_disparity_leaves_pictures_in_colour_alone(
    pair_run: SimpleNamespace, tmp_path: Path
) -> None:
    with RunDirectory(tmp_path / "run") as directory:
        present_disparity(pair_run, directory)  # type: ignore[arg-type]
        directory.write_json("run.json", {})
    folder = tmp_path / "run" / "disparity"
    names = {"disparity_colour.png", "confidence_colour.png", "reason_colour.png"}
    assert {path.name for path in folder.iterdir()} == names
    assert not (tmp_path / "run" / "report.html").exists()
    reasons = cv2.imread(str(folder / "reason_colour.png"))[:, :, ::-1]
    np.testing.assert_array_equal(reasons[0, 0], REASON_COLOURS[Reason.BORDER])


def test_drive_leaves_its_report(
    pair: RectifiedPair,
    disparity: Disparity,
    cloud: PointCloud,
    trajectory: Trajectory,
    T_map_world: Float64,
    grid: OccupancyGrid,
    tmp_path: Path,
) -> None:
    mapped = SimpleNamespace(
        trajectory=trajectory,
        T_map_world=T_map_world,
        health=(),
        sample=SimpleNamespace(pair=pair, disparity=disparity),
        loops=None,
    )
    run = SimpleNamespace(
        name="drives/street",
        config=ReconConfig(),
        mapped=mapped,
        cloud=cloud,
        grid=grid,
        mesh=None,
        truth=None,
        metrics=None,
        summary={},
        warnings=(),
    )
    with RunDirectory(tmp_path / "run") as directory:
        present_map(run, directory)  # type: ignore[arg-type]
        directory.write_json("run.json", {})
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Map of street" in page
    assert "Stereo, frame 7" in page


@pytest.mark.parametrize(
    ("program", "line"),
    [
        ("bin/recon", "recon map 'a b'"),
        ("site-packages/recon/__main__.py", "recon map 'a b'"),
        ("other.py", ""),
    ],
)
def test_report_names_the_command_that_made_it_and_no_other_program(
    program: str, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [program, "map", "a b"])
    assert command_line() == line
