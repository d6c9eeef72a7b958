"""`recon live LEFT RIGHT` maps what two cameras see; two video files stand in for them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from recon.cli import app
from recon.core.errors import SourceError
from recon.core.values import RectifiedCamera, StereoPair
from recon.io.trajectory import read_tum
from recon.rig import capture
from recon.rig.cameras import CameraSource, is_camera, open_camera_source
from recon.rig.capture import CaptureSettings, RecordingSettings
from recon.sources.live import LiveSource
from recon.sources.settings import SourceSettings
from tests.commands.test_capture import FakeCamera
from tests.scenery.film import Film
from tests.scenery.patience import be_patient
from tests.sources import drives

SMALL = RectifiedCamera(10.0, 5.5, 3.5, 5.5, 0.5, 12, 8)
"""Of the images of `FakeCamera`."""


@pytest.fixture(scope="module")
def videos(street_film: Film, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    grey = street_film.taken(slice(None), lambda image: image[..., 1].copy())
    return drives.write_two_videos(grey.pairs, grey.calibration, folder)


def _live(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["live", *map(str, words), "--quiet"])
    return done.exit_code, done.output


def test_two_cameras_are_mapped(
    videos: Path, street_film: Film, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    be_patient(monkeypatch)
    out = tmp_path / "run"

    code, text = _live(
        *(videos / "left.avi", videos / "right.avi", "--calib", videos / "calib.txt"),
        *("--rate", 5, "--out", out),
    )

    assert code == 0, text
    summary = json.loads((out / "summary.json").read_text())
    path = read_tum(out / "trajectory_tum.txt")
    # The first pair gives the image size, three more warm up.
    assert summary["frames"] == len(path) == len(street_film) - 4
    truth = street_film.trajectory.positions_m
    length_m = np.linalg.norm(np.diff(truth[4:], axis=0), axis=1).sum()
    assert path.path_length_m == pytest.approx(length_m, rel=0.05)
    assert (out / "map" / "cloud.ply").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["left.avi", "right.avi"], "--calib"),
        (["left.avi", "none.avi", "--calib", "calib.txt"], "camera cannot be opened"),
        (["/dev/video99", "--calib", "calib.txt"], "camera cannot be opened"),
        (["99", "--calib", "calib.txt"], "camera cannot be opened"),
        (["nothing"], "folder does not exist"),
    ],
)
def test_what_is_no_camera_is_refused_in_one_line(
    videos: Path, tmp_path: Path, words: list[str], said: str
) -> None:
    known = {path.name for path in videos.iterdir()}
    names = [videos / word if word in known else word for word in words]

    code, text = _live(*names, "--out", tmp_path / "run")

    assert code == 1
    assert said in text
    assert text.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_numbers_devices_and_addresses_are_cameras(tmp_path: Path) -> None:
    (tmp_path / "drive").mkdir()

    assert [is_camera(name) for name in ("0", "rtsp://host/left", "/dev/video9")] == [True] * 3
    assert not is_camera(str(tmp_path / "drive"))
    assert not is_camera("rides/today")


def test_pairs_are_numbered_and_keep_the_time_they_were_taken() -> None:
    stamps_s = [5.0, 5.1, 5.2, 5.3]
    cameras = (FakeCamera("0", stamps_s), FakeCamera("2", [t + 0.004 for t in stamps_s]))
    source = CameraSource(cameras, RecordingSettings(frames=2), SMALL)

    pairs: list[StereoPair] = list(source)

    assert [(pair.index, pair.timestamp_s) for pair in pairs] == [(0, 5.0), (1, 5.1)]
    assert [(pair.index, pair.timestamp_s) for pair in source] == [(0, 5.2), (1, 5.3)]
    assert (source.name, len(source), source.live) == ("0 and 2", 2, True)


def test_a_camera_that_falls_silent_ends_the_drive_with_an_error() -> None:
    cameras = (FakeCamera("0", [1.0, 1.1]), FakeCamera("2", [1.0]))
    played = LiveSource(CameraSource(cameras, RecordingSettings(), SMALL), rate=None)

    with pytest.raises(SourceError, match="camera gives no more frames"):
        list(played)


def test_rectified_cameras_need_two_numbers_and_no_file(videos: Path) -> None:
    devices = [str(videos / "left.avi"), str(videos / "right.avi")]
    numbers = SourceSettings(focal_px=300, baseline_m=0.2)
    with open_camera_source(devices, CaptureSettings(), numbers) as source:
        assert isinstance(source.calibration, RectifiedCamera)
        assert (source.calibration.focal_px, source.calibration.baseline_m) == (300, 0.2)


def test_the_calibration_is_that_of_the_image_size(videos: Path, tmp_path: Path) -> None:
    devices = [str(videos / "left.avi"), str(videos / "right.avi")]
    wrong = tmp_path / "calib.txt"
    wrong.write_text(
        "cam0=[10 0 9; 0 10 9; 0 0 1]\ncam1=[10 0 9; 0 10 9; 0 0 1]\nbaseline=500\n"
        "doffs=0\nwidth=18\nheight=18\n"
    )

    with (
        pytest.raises(Exception, match="size"),
        open_camera_source(devices, CaptureSettings(), SourceSettings(calibration=str(wrong))),
    ):
        pass
    assert capture._WARM_UP_FRAMES > 0
