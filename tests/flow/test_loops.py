"""Loops around a block are closed, interrupted or not; a repetitive street gives no false loop."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.map import MapRun, run_map
from recon.commands.map_options import MapOptions
from recon.core.values import SequenceTruth, StereoPair
from recon.io.trajectory import read_tum
from recon.map.drive.mapper import FrameResult
from recon.run.progress import Silent
from recon.sources.source import DerivedSource
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.street.settings import CORNER_M, StreetScene

pytestmark = pytest.mark.slow

RIG = {"width_px": 400, "height_px": 150, "focal_px": 225.0, "smooth_edges": False}
SIDE_M, STEP_M = 60.0, 1.5
LAP_M = 4 * SIDE_M - 8 * CORNER_M + 2 * math.pi * CORNER_M
BLOCK = StreetScene(
    path="block", block_m=(SIDE_M, SIDE_M), frames=162, speed_m_per_frame=STEP_M, seed=1, **RIG
)
ALIKE = StreetScene(
    path="straight", repeat_m=40.0, frames=56, speed_m_per_frame=STEP_M, seed=1, **RIG
)
FILES = [
    "trajectory_kitti.txt",
    "trajectory_tum.txt",
    "trajectory_map_base_tum.txt",
    "map/cloud.ply",
    "map/grid.pgm",
    "map/octomap.ot",
    "map/octomap.bt",
]


class _Filmed(DerivedSource):
    """A drive whose images are rendered once, and whose path alone is known."""

    def __init__(self, settings: StreetScene) -> None:
        street = SyntheticSource(settings)
        super().__init__(street)
        self.truth = SequenceTruth(street.trajectory)
        self._pairs = list(street)

    def __len__(self) -> int:
        return len(self._pairs)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        return iter(self._pairs[start:])


class _Breaks(Silent):
    """A progress that interrupts a run before a frame is reported."""

    def __init__(self, frame: int) -> None:
        self.frame = frame

    def on_step(self, result: FrameResult) -> None:
        if result.index == self.frame:
            raise KeyboardInterrupt


def _run(
    drive: _Filmed, out: Path, *settings: str, resume: bool = False, breaks: int = -1
) -> MapRun:
    options = MapOptions(audit=False, out=out, mesh=False, resume=resume, progress=_Breaks(breaks))
    return run_map(drive, load_config(None, settings), options)


def _content(folder: Path, *more: str) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in [*FILES, *more]}


@pytest.fixture(scope="module")
def block() -> _Filmed:
    return _Filmed(BLOCK)


@pytest.fixture(scope="module")
def closed(block: _Filmed, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MapRun, int]:
    """Folder and run of the drive, and how many pairs were matched."""
    folder = tmp_path_factory.mktemp("closed")
    match = FrameReconstructor.reconstruct_rectified
    with patch.object(
        FrameReconstructor, "reconstruct_rectified", autospec=True, side_effect=match
    ) as asked:
        run = _run(block, folder)
    return folder, run, asked.call_count


def test_a_drive_around_a_block_closes_to_a_fifth_of_a_percent(
    closed: tuple[Path, MapRun, int],
) -> None:
    folder, run, _ = closed
    truth = run.errors.true_path
    assert truth is not None
    before_m, after_m = (
        np.linalg.norm(read_tum(folder / name).positions_m[-1] - truth.positions_m[-1])
        for name in ("trajectory_odometry_tum.txt", "trajectory_tum.txt")
    )
    assert after_m < 0.002 * truth.path_length_m
    # Odometry alone is as good after one lap, but it goes on to drift: what is left is far less.
    assert after_m < before_m / 3


def test_loops_stand_in_summary_report_and_file(closed: tuple[Path, MapRun, int]) -> None:
    folder, run, _ = closed
    figures = json.loads((folder / "summary.json").read_text())["loops"]
    edges = json.loads((folder / "loops.json").read_text())

    assert figures["closed"] == len(edges["closed"]) >= 5
    assert figures["refused_by_graph"] == len(edges["refused"]) == 0
    assert 0.1 < figures["largest_correction_m"] < 5.0
    for edge in edges["closed"]:
        way_m = STEP_M * (edge["last"] - edge["first"])
        assert way_m == pytest.approx(LAP_M, abs=8.0)  # places that far apart may still be matched
    page = (folder / "report.html").read_text()
    assert f"{figures['closed']} of {figures['found']}" in page
    assert run.warnings == ()


def test_the_map_is_rebuilt_without_matching_again(closed: tuple[Path, MapRun, int]) -> None:
    assert closed[2] == BLOCK.frames


def test_a_drive_that_was_broken_off_after_its_loops_closes_in_the_same_way(
    block: _Filmed, closed: tuple[Path, MapRun, int], tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt, match="--resume"):
        _run(block, tmp_path, breaks=BLOCK.frames - 6)
    run = _run(block, tmp_path, resume=True)

    more = ("loops.json", "trajectory_odometry_tum.txt")
    assert _content(tmp_path, *more) == _content(closed[0], *more)
    assert run.summary["loops"] == closed[1].summary["loops"]


def test_a_street_that_repeats_itself_is_mapped_as_if_nobody_looked_for_loops(
    tmp_path: Path,
) -> None:
    drive = _Filmed(ALIKE)
    looked = _run(drive, tmp_path / "looked")
    _run(drive, tmp_path / "off", "loops.enabled=false")
    with patch.multiple("recon.places.places", SHARE=1.0, TURN_DEG=5.0):
        blind = _run(drive, tmp_path / "blind")

    assert looked.summary["loops"]["found"] == 0
    assert _content(tmp_path / "looked") == _content(tmp_path / "off")
    assert not (tmp_path / "looked" / "loops.json").exists()
    # The trap is a real one: images and shapes alone would have closed it.
    assert blind.summary["loops"]["found"] >= 3
