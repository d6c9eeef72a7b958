"""A drive that breaks: what is seen again is joined, the rest stays apart, and is said first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.localize import run_live
from recon.commands.map import MapResult, run_map
from recon.commands.map_options import MapOptions
from recon.core.progress import showing
from recon.io.trajectory import read_tum
from recon.street.settings import StreetScene
from tests.flow.runs import Breaks, content, summary_of
from tests.scenery.film import RIG, Film, film
from tests.scenery.patience import be_patient


@pytest.fixture(scope="module")
def broken(street_film: Film) -> Film:
    """A street, five frames of another one, and the first street again, in less light."""
    other = film(StreetScene(frames=5, seed=5, **RIG))
    again = street_film.taken(slice(None), lambda image: (0.8 * image).astype(np.uint8))
    parts = (street_film, other, again)
    poses = np.concatenate([part.trajectory.T_world_camera for part in parts])
    pairs = [pair for part in parts for pair in part.pairs]
    return Film(pairs, street_film.calibration, poses)


def _map(drive: Film, out: Path, *, resume: bool = False, breaks: int = -1) -> MapResult:
    options = MapOptions(audit=False, out=out, mesh=False, resume=resume)
    with showing(Breaks(breaks)):
        return run_map(drive, load_config(None, ["checkpoints.every_frames=5"]), options)


@pytest.fixture(scope="module")
def whole(broken: Film, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MapResult]:
    folder = tmp_path_factory.mktemp("whole")
    return folder, _map(broken, folder)


def test_a_place_seen_again_joins_what_a_break_has_parted(
    street_film: Film, whole: tuple[Path, MapResult]
):
    folder, run = whole
    summary, count = summary_of(folder), len(street_film)
    assert [(one["first"], one["last"], one["joined"]) for one in summary["segments"]] == [
        (0, count - 1, True), (count, count + 4, False), (count + 5, 2 * count + 4, True),
    ]  # fmt: skip
    assert summary["frames_joined"] == 2 * count
    path = read_tum(folder / "trajectory_tum.txt")
    truth = np.tile(street_film.trajectory.positions_m, (2, 1))
    assert np.linalg.norm(path.positions_m - truth, axis=1).max() < 0.1
    first = run.warnings[0]
    assert first.startswith("TRAJECTORY HAS 3 SEGMENTS")
    assert f"frames {count}-{count + 4}" in first
    assert first in (folder / "report.html").read_text()
    apart = sorted(path.relative_to(folder) for path in (folder / "segments").rglob("*.txt"))
    assert apart == [Path("segments/1/trajectory_tum.txt")]
    assert len(read_tum(folder / apart[0])) == 5


def test_live_the_segments_are_the_same_and_said_first(
    street_film: Film, broken: Film, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    be_patient(monkeypatch)
    options = MapOptions("live", tmp_path, mesh=False)
    summary, count = run_live(broken, load_config(), options, rate=10.0).to_json(), len(street_film)
    segments = [(one["first"], one["joined"]) for one in summary["segments"]]
    assert segments == [(0, True), (count, False), (count + 5, True)]
    assert summary["warnings"][0].startswith("TRAJECTORY HAS 3 SEGMENTS")


@pytest.mark.slow
def test_a_run_that_was_killed_after_the_breaks_gives_the_same_segments(
    broken: Film, whole: tuple[Path, MapResult], tmp_path: Path
):
    with pytest.raises(KeyboardInterrupt, match="--resume"):
        _map(broken, tmp_path, breaks=len(broken) - 4)
    _map(broken, tmp_path, resume=True)
    assert content(tmp_path) == content(whole[0])
