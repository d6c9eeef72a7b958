"""`recon live` makes the map of `recon map` where it keeps up, and tells what it left out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.commands.localize import run_live
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import MappingError, SettingsError, SourceError
from recon.io.trajectory import read_tum
from recon.map.drive.drive import MapBehind
from recon.run.progress import Silent
from recon.sources import live
from recon.sources.live import LiveSource
from recon.sources.source import DerivedSource
from tests.scenery.film import Film
from tests.scenery.patience import be_patient


@pytest.fixture(scope="module")
def config() -> ReconConfig:
    return load_config()


@pytest.fixture(scope="module")
def street(street_film: Film) -> Film:
    return street_film.taken(slice(0, 8))


@pytest.fixture(scope="module")
def mapped(street: Film, config: ReconConfig, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("mapped") / "run"
    run_map(street, config, MapOptions(out=out, mesh=False, audit=False))
    return out


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine is, nothing is left out."""
    be_patient(monkeypatch)


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all frames but the first nothing is mapped but the pose."""
    monkeypatch.setattr(live, "_WAITING", 1000)
    monkeypatch.setattr(
        MapBehind,
        "_map",
        lambda self, late, last: self._map_frame(*late, late[0].index == 0),
    )


def _live(source, config, out: Path, **options) -> dict:
    return run_live(source, config, MapOptions("live", out, mesh=False), rate=10.0, **options)


def _off_m(run: Path, street: Film) -> np.ndarray:
    found = read_tum(run / "trajectory_tum.txt").positions_m
    return np.linalg.norm(found - street.trajectory.positions_m, axis=1)


def test_a_drive_that_is_kept_up_with_gives_the_same_map(
    street, config, mapped, patient, tmp_path
) -> None:
    """But for the poses, which rest on features alone."""
    summary = _live(street, config, tmp_path / "live")

    usual = json.loads((mapped / "summary.json").read_text())
    assert summary["points"] == pytest.approx(usual["points"], rel=0.05)
    assert summary["odometry"] == "visual"
    assert _off_m(tmp_path / "live", street).max() < 0.1
    assert summary["live"]["frames_arrived"] == 8
    assert summary["live"]["frames_dropped"] == summary["live"]["frames_not_matched"] == 0
    assert summary["live"]["latency_ms"]["p95"] > 0
    assert json.loads((tmp_path / "live" / "summary.json").read_text()) == summary


def test_a_machine_that_is_much_too_slow_has_poses_and_is_told_why_there_is_no_map(
    street, config, hurried, monkeypatch, tmp_path
) -> None:
    poses = []
    monkeypatch.setattr(LiveSource, "warnings", lambda self: ["7 frames came too fast"])

    class Watch(Silent):
        def on_step(self, step) -> None:
            poses.append(step)

    options = MapOptions("live", tmp_path / "live", mesh=False, progress=Watch())
    with pytest.raises(MappingError, match=r"the map is empty.*7 frames came too fast.*--rate"):
        run_live(street, config, options, rate=10.0)

    found = np.stack([pose.T_world_camera[:3, 3] for pose in poses])
    assert np.linalg.norm(found - street.trajectory.positions_m, axis=1).max() < 0.2
    assert all(pose.ok for pose in poses)
    assert not (tmp_path / "live" / "summary.json").exists()


def test_a_drive_ends_when_it_is_told_to_and_its_map_is_completed(
    street, config, patient, tmp_path
) -> None:
    arrived = []

    class Watch(Silent):
        def on_step(self, step) -> None:
            arrived.append(step)

    options = MapOptions("live", tmp_path / "live", mesh=False, progress=Watch())
    summary = run_live(street, config, options, rate=10.0, stopped=lambda: len(arrived) >= 5)

    assert summary["frames"] == 5
    assert (tmp_path / "live" / "map" / "cloud.ply").is_file()


class _WithGap(DerivedSource):
    """A street whose second image comes an hour after the first."""

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0):
        for pair in self.source.frames(start):
            late_s = 3600.0 if pair.index else 0.0
            yield replace(pair, timestamp_s=pair.timestamp_s + late_s)


def test_a_gap_at_the_beginning_is_not_waited_for_twice(street, config, patient, tmp_path) -> None:
    arrived = []

    class Watch(Silent):
        def on_step(self, step) -> None:
            arrived.append(step)

    options = MapOptions("live", tmp_path / "live", mesh=False, progress=Watch())
    summary = run_live(_WithGap(street), config, options, stopped=lambda: bool(arrived))

    assert summary["frames"] == 1


def test_a_drive_that_is_stopped_before_it_began_says_so(street, config, tmp_path) -> None:
    options = MapOptions("live", tmp_path / "live", mesh=False)
    with pytest.raises(SourceError, match="stopped before its first frame"):
        run_live(street, config, options, stopped=lambda: True)
    assert not (tmp_path / "live").exists()


def test_kiss_icp_comes_too_late_for_live_poses(street, tmp_path) -> None:
    config = load_config(None, ["odometry.method=kiss"])

    with pytest.raises(SettingsError, match="the points that kiss-icp needs"):
        _live(street, config, tmp_path / "live")


def test_a_drive_is_found_in_a_map_while_it_arrives(
    street, config, mapped, patient, tmp_path
) -> None:
    summary = _live(street, config, tmp_path / "live", map_path=mapped)

    assert summary["frames_tracking"] + summary["frames_coasting"] >= 7
    assert summary["live"]["frames_arrived"] == 8
    assert (tmp_path / "live" / "states.csv").is_file()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_cannot_be_is_refused(street, config, tmp_path, rate) -> None:
    with pytest.raises(SettingsError, match="not a rate"):
        run_live(street, config, MapOptions("live", tmp_path / "live"), rate=rate)
