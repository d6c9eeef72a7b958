"""`recon live` makes the map of `recon map` where it keeps up, from a drive or two cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.commands.localize import run_live
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import CalibrationError, MappingError, SettingsError, SourceError
from recon.core.values import RectifiedCamera
from recon.io.trajectory import read_tum
from recon.map.drive.drive import MapBehind
from recon.map.drive.mapper import FrameResult
from recon.rig.cameras import CameraSource, is_camera, open_camera_source
from recon.rig.capture import CaptureSettings, RecordingSettings
from recon.run.work import Silent
from recon.sources import live
from recon.sources.live import LiveSource
from recon.sources.settings import SourceSettings
from recon.sources.source import DerivedSource, StereoSource
from tests.commands.test_cameras import FakeCamera
from tests.flow.runs import summary_of
from tests.hostile.refusals import assert_refused, run
from tests.scenery.film import Film
from tests.scenery.patience import be_patient
from tests.sources import drives

SMALL = RectifiedCamera(10.0, 5.5, 3.5, 5.5, 0.5, 12, 8)
"""Of the images of `FakeCamera`."""
Play = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def street(street_film: Film) -> Film:
    return street_film.taken(slice(0, 8))


@pytest.fixture(scope="module")
def mapped(street: Film, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mapped") / "run"
    run_map(street, load_config(), MapOptions(out=out, mesh=False, audit=False))
    return out


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine is, nothing is left out."""
    be_patient(monkeypatch)


class Watch(Silent):
    """Keeps the frames that are done."""

    def __init__(self) -> None:
        self.steps: list[FrameResult] = []

    def on_step(self, step: FrameResult) -> None:
        self.steps.append(step)


@pytest.fixture
def watch() -> Watch:
    return Watch()


@pytest.fixture
def play(tmp_path: Path, watch: Watch) -> Play:
    """Play a drive into ``tmp_path/live``; its summary."""

    def play_drive(
        source: StereoSource, config: ReconConfig | None = None, rate: float = 10.0, **options: Any
    ) -> dict[str, Any]:
        into = MapOptions("live", tmp_path / "live", mesh=False, progress=watch)
        return run_live(source, config or load_config(), into, rate=rate, **options)

    return play_drive


def test_a_drive_that_is_kept_up_with_gives_the_same_map(
    street: Film, mapped: Path, patient: None, play: Play, tmp_path: Path
) -> None:
    """But for the poses, which rest on features alone."""
    summary, usual = play(street), summary_of(mapped)
    assert summary["points"] == pytest.approx(usual["points"], rel=0.05)
    assert summary["odometry"] == "visual"
    found_m = read_tum(tmp_path / "live" / "trajectory_tum.txt").positions_m
    assert np.linalg.norm(found_m - street.trajectory.positions_m, axis=1).max() < 0.1
    assert summary["live"]["frames_arrived"] == 8
    assert summary["live"]["frames_dropped"] == summary["live"]["frames_not_matched"] == 0
    assert summary["live"]["latency_ms"]["p95"] > 0
    assert summary_of(tmp_path / "live") == summary


def test_a_machine_that_is_much_too_slow_has_poses_and_is_told_why_there_is_no_map(
    street: Film, play: Play, watch: Watch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def of_the_first(self: MapBehind, late: Any, last: object) -> None:
        self._map_frame(*late, late[0].index == 0)

    monkeypatch.setattr(live, "_WAITING", 1000)
    monkeypatch.setattr(MapBehind, "_map", of_the_first)
    monkeypatch.setattr(LiveSource, "warnings", lambda self: ["7 frames came too fast"])
    with pytest.raises(MappingError, match=r"the map is empty.*7 frames came too fast.*--rate"):
        play(street)
    found_m = np.stack([step.T_world_camera[:3, 3] for step in watch.steps])
    assert np.linalg.norm(found_m - street.trajectory.positions_m, axis=1).max() < 0.2
    assert all(step.ok for step in watch.steps)
    assert not (tmp_path / "live" / "summary.json").exists()


class _WithGap(DerivedSource):
    """A street whose second image comes an hour after the first."""

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0):
        for pair in self.source.frames(start):
            late_s = 3600.0 if pair.index else 0.0
            yield replace(pair, timestamp_s=pair.timestamp_s + late_s)


def test_a_drive_ends_when_it_is_told_to_and_its_map_is_completed(
    street: Film, patient: None, play: Play, watch: Watch, tmp_path: Path
) -> None:
    with pytest.raises(SourceError, match="stopped before its first frame"):
        play(street, stopped=lambda: True)
    assert not (tmp_path / "live").exists()
    assert play(street, stopped=lambda: len(watch.steps) >= 5)["frames"] == 5
    assert (tmp_path / "live" / "map" / "cloud.ply").is_file()
    watch.steps.clear()
    # A gap at the beginning is not waited for.
    assert play(_WithGap(street), rate=1.0, stopped=lambda: bool(watch.steps))["frames"] == 1


def test_a_drive_is_found_in_a_map_while_it_arrives(
    street: Film, mapped: Path, patient: None, play: Play, tmp_path: Path
) -> None:
    summary = play(street, map_path=mapped)
    assert summary["frames_tracking"] + summary["frames_coasting"] >= 7
    assert summary["live"]["frames_arrived"] == 8
    assert (tmp_path / "live" / "states.csv").is_file()


def test_what_cannot_be_played_is_refused(street: Film, play: Play) -> None:
    with pytest.raises(SettingsError, match="the points that kiss-icp needs"):
        play(street, load_config(None, ["odometry.method=kiss"]))
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SettingsError, match="not a rate"):
            play(street, rate=rate)


@pytest.fixture(scope="module")
def videos(street_film: Film, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two video files that stand in for cameras."""
    folder = tmp_path_factory.mktemp("videos")
    grey = street_film.taken(slice(None), lambda image: image[..., 1].copy())
    return drives.write_two_videos(grey.pairs, grey.calibration, folder)


def test_two_cameras_are_mapped(
    videos: Path, street_film: Film, patient: None, tmp_path: Path
) -> None:
    out, names = tmp_path / "run", [videos / name for name in ("left.avi", "right.avi")]
    done = run("live", *names, "--calib", videos / "calib.txt", "--rate", "5", "--out", out)
    assert done.code == 0, done.err
    path = read_tum(out / "trajectory_tum.txt")
    # The first pair gives the image size, three more warm up.
    frames = summary_of(out)["frames"]
    assert frames == len(path) == len(street_film) - 4
    truth = street_film.trajectory.positions_m
    length_m = np.linalg.norm(np.diff(truth[4:], axis=0), axis=1).sum()
    assert path.path_length_m == pytest.approx(length_m, rel=0.05)
    assert (out / "map" / "cloud.ply").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("{}/left.avi {}/right.avi", "--calib"),
        ("{}/left.avi none.avi --calib {}/calib.txt", "camera cannot be opened"),
        ("/dev/video99 --calib {}/calib.txt", "camera cannot be opened"),
        ("99 --calib {}/calib.txt", "camera cannot be opened"),
        ("nothing", "folder does not exist"),
    ],
)
def test_what_is_no_camera_is_refused_in_one_line(
    videos: Path, tmp_path: Path, words: str, said: str
) -> None:
    names = words.replace("{}", str(videos)).split()
    assert_refused(run("live", *names, "--out", tmp_path / "run", "--quiet"), said)
    assert not (tmp_path / "run").exists()


def test_pairs_of_cameras_are_numbered_and_keep_the_time_they_were_taken() -> None:
    stamps_s = [5.0, 5.1, 5.2, 5.3, 5.4]
    cameras = (FakeCamera("0", stamps_s), FakeCamera("2", [t + 0.004 for t in stamps_s[:4]]))
    source = CameraSource(cameras, RecordingSettings(frames=2), SMALL)
    assert (source.name, len(source), source.live) == ("0 and 2", 2, True)
    assert [(pair.index, pair.timestamp_s) for pair in source] == [(0, 5.0), (1, 5.1)]
    assert [(pair.index, pair.timestamp_s) for pair in source] == [(0, 5.2), (1, 5.3)]
    with pytest.raises(SourceError, match="camera gives no more frames"):
        list(LiveSource(source, rate=None))


def test_cameras_are_numbers_devices_and_files_with_a_calibration_of_their_size(
    videos: Path, tmp_path: Path
) -> None:
    assert [is_camera(name) for name in ("0", "rtsp://host/left", "/dev/video9")] == [True] * 3
    assert [is_camera(name) for name in (str(tmp_path), "rides/today")] == [False] * 2
    devices = [str(videos / "left.avi"), str(videos / "right.avi")]
    numbers = SourceSettings(focal_px=300, baseline_m=0.2)
    with open_camera_source(devices, CaptureSettings(), numbers) as source:
        assert isinstance(source.calibration, RectifiedCamera)
        assert (source.calibration.focal_px, source.calibration.baseline_m) == (300, 0.2)
    wrong = SourceSettings(calibration=str(tmp_path / "calib.txt"))
    (tmp_path / "calib.txt").write_text(
        "cam0=[10 0 9; 0 10 9; 0 0 1]\ncam1=[10 0 9; 0 10 9; 0 0 1]\nbaseline=500\n"
        "doffs=0\nwidth=18\nheight=18\n"
    )
    with pytest.raises(CalibrationError, match="size"):
        open_camera_source(devices, CaptureSettings(), wrong).__enter__()
