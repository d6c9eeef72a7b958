"""Loops around a block are closed, interrupted or not; a repetitive street gives no false loop."""

import json
import math
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.map import MapResult, run_map
from recon.commands.map_options import MapOptions
from recon.core.progress import showing
from recon.core.values import SequenceTruth
from recon.io.trajectory import read_tum
from recon.stereo.frame import FrameReconstructor
from recon.street.settings import CORNER_M, StreetScene
from tests.flow.runs import Breaks, content, summary_of
from tests.scenery.film import Film, film

pytestmark = pytest.mark.slow

Closed = tuple[Path, MapResult]
SIDE_M, STEP_M = 60.0, 1.5
LAP_M = 4 * SIDE_M - 8 * CORNER_M + 2 * math.pi * CORNER_M


def _film(**street: object) -> Film:
    """A drive whose path alone is known."""
    rig = {"width_px": 400, "height_px": 150, "focal_px": 225.0, "smooth_edges": False}
    made = film(StreetScene(speed_m_per_frame=STEP_M, seed=1, **rig, **street))
    made.truth = SequenceTruth(made.trajectory)
    return made


def _run(
    drive: Film, out: Path, *settings: str, resume: bool = False, breaks: int = -1
) -> MapResult:
    options = MapOptions(audit=False, out=out, mesh=False, resume=resume)
    with showing(Breaks(breaks)):
        return run_map(drive, load_config(None, settings), options)


def _content(folder: Path) -> dict[str, bytes]:
    """What does not say by which settings it was made."""
    made = content(folder)
    return {name: made[name] for name in made if name not in ("config.yaml", "map/map.recon")}


@pytest.fixture(scope="module")
def block():
    return _film(path="block", block_m=(SIDE_M, SIDE_M), frames=162)


@pytest.fixture(scope="module")
def closed(block, tmp_path_factory):
    """Folder and run of the drive; the map is rebuilt without matching again."""
    folder = tmp_path_factory.mktemp("closed")
    match = FrameReconstructor.reconstruct_rectified
    with patch.object(
        FrameReconstructor, "reconstruct_rectified", autospec=True, side_effect=match
    ) as asked:
        run = _run(block, folder)
    assert asked.call_count == len(block)
    return folder, run


def test_a_drive_around_a_block_closes_to_a_fifth_of_a_percent(closed):
    folder, run = closed
    truth = run.errors.true_path
    before_m, after_m = (
        np.linalg.norm(read_tum(folder / name).positions_m[-1] - truth.positions_m[-1])
        for name in ("trajectory_odometry_tum.txt", "trajectory_tum.txt")
    )
    assert after_m < 0.002 * truth.path_length_m
    # Odometry alone is as good after one lap, but it goes on to drift: what is left is far less.
    assert after_m < before_m / 3
    figures = summary_of(folder)["loops"]
    edges = json.loads((folder / "loops.json").read_text())
    assert figures["closed"] == len(edges["closed"]) >= 5
    assert figures["refused_by_graph"] == len(edges["refused"]) == 0
    assert 0.1 < figures["largest_correction_m"] < 5.0
    for edge in edges["closed"]:
        way_m = STEP_M * (edge["last"] - edge["first"])
        assert way_m == pytest.approx(LAP_M, abs=8.0)  # places that far apart may still be matched
    assert f"{figures['closed']} of {figures['found']}" in (folder / "report.html").read_text()
    assert run.warnings == ()


def test_a_drive_broken_off_closes_the_same_way(block, closed, tmp_path):
    with pytest.raises(KeyboardInterrupt, match="--resume"):
        _run(block, tmp_path, breaks=len(block) - 6)
    run = _run(block, tmp_path, resume=True)
    assert {"loops.json", "trajectory_odometry_tum.txt"} <= _content(tmp_path).keys()
    assert _content(tmp_path) == _content(closed[0])
    assert run.summary.to_json()["loops"] == closed[1].summary.to_json()["loops"]


def test_a_walk_round_a_room_with_mirrors_and_windows_closes(tmp_path):
    size = {"width_px": 256, "height_px": 160, "focal_px": 144.0, "smooth_edges": False}
    # Steps of twice the usual length, of which odometry loses one.
    walk = film(StreetScene(path="room", seed=2, frames=90, speed_m_per_frame=0.2, **size))
    walk.truth = SequenceTruth(walk.trajectory)
    run = _run(walk, tmp_path)
    assert run.summary.to_json()["frames_joined"] == len(walk)
    assert run.summary.to_json()["trajectory"]["ate_m"] < 0.005 * walk.trajectory.path_length_m
    assert run.summary.to_json()["loops"]["closed"] >= 10
    assert run.summary.to_json()["loops"]["refused_by_graph"] == 0


def test_a_street_that_repeats_itself_is_mapped_without_loops(tmp_path):
    drive = _film(path="straight", repeat_m=40.0, frames=56)
    looked = _run(drive, tmp_path / "looked")
    _run(drive, tmp_path / "off", "loops.enabled=false")
    with patch.multiple("recon.places.places", SHARE=1.0, TURN_DEG=5.0):
        blind = _run(drive, tmp_path / "blind")
    assert looked.summary.to_json()["loops"]["found"] == 0
    assert _content(tmp_path / "looked") == _content(tmp_path / "off")
    assert not (tmp_path / "looked" / "loops.json").exists()
    # The trap is a real one: images and shapes alone would have closed it.
    assert blind.summary.to_json()["loops"]["found"] >= 3
