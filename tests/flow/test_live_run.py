"""`recon live` makes the map of `recon map` where it keeps up, and tells what it left out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.commands.live import run_live
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import MappingError, SettingsError
from recon.io.trajectory import read_tum
from recon.map.store.map import Map
from recon.sources import live
from recon.sources.live import LiveSource
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene

STREET = StreetScene(
    frames=8, width_px=400, height_px=150, focal_px=225.0, smooth_edges=False, seed=1
)


@pytest.fixture(scope="module")
def config() -> ReconConfig:
    return load_config()


@pytest.fixture(scope="module")
def street() -> SyntheticSource:
    return SyntheticSource(STREET)


@pytest.fixture(scope="module")
def mapped(street: SyntheticSource, config: ReconConfig, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("mapped") / "run"
    run_map(street, config, MapOptions(out=out, mesh=False, audit=False))
    return out


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine is, nothing is left out."""
    monkeypatch.setattr(live, "_WAITING", 1000)
    monkeypatch.setattr(LiveSource, "hurried", lambda self, pair: False)


def _live(source, config, out: Path, **options) -> dict:
    return run_live(source, config, MapOptions("live", out, mesh=False), rate=10.0, **options)


def test_a_drive_that_is_kept_up_with_gives_the_same_map(
    street, config, mapped, patient, tmp_path
) -> None:
    summary = _live(street, config, tmp_path / "live")

    for name in ("trajectory_tum.txt", "map/cloud.ply", "map/grid.pgm"):
        assert (tmp_path / "live" / name).read_bytes() == (mapped / name).read_bytes()
    assert summary["live"]["frames_arrived"] == 8
    assert summary["live"]["frames_dropped"] == 0
    assert summary["live"]["latency_ms"]["p95"] > 0
    assert json.loads((tmp_path / "live" / "summary.json").read_text()) == summary


def test_frames_that_are_not_matched_are_tracked(
    street, config, patient, monkeypatch, tmp_path
) -> None:
    monkeypatch.setattr(LiveSource, "hurried", lambda self, pair: pair.index % 2 == 1)

    _live(street, config, tmp_path / "live")

    found = read_tum(tmp_path / "live" / "trajectory_tum.txt")
    off = np.linalg.norm(found.positions_m - street.trajectory.positions_m, axis=1)
    assert off.max() < 0.2
    with Map.open(tmp_path / "live") as map_:
        assert all(health.ok for health in map_.session().health)


def test_a_drive_is_found_in_a_map_while_it_arrives(
    street, config, mapped, patient, tmp_path
) -> None:
    summary = _live(street, config, tmp_path / "live", map_path=mapped)

    assert summary["frames_tracking"] >= 7
    assert summary["live"]["frames_arrived"] == 8
    assert (tmp_path / "live" / "states.csv").is_file()


def test_a_machine_that_is_much_too_slow_is_told_so(street, config, monkeypatch, tmp_path) -> None:
    """Of frames that were all tracked alone, there is no map."""
    monkeypatch.setattr(live, "_WAITING", 1000)
    monkeypatch.setattr(LiveSource, "hurried", lambda self, pair: pair.index > 0)
    monkeypatch.setattr(LiveSource, "warnings", lambda self: ["7 frames came too fast"])

    with pytest.raises(MappingError, match=r"the map is empty.*7 frames came too fast.*--rate"):
        _live(street, config, tmp_path / "live")
    assert not (tmp_path / "live" / "summary.json").exists()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_cannot_be_is_refused(street, config, tmp_path, rate) -> None:
    with pytest.raises(SettingsError, match="a rate is positive"):
        run_live(street, config, MapOptions("live", tmp_path / "live"), rate=rate)
