"""A recording can be mapped at once, and is valid whatever happens."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recon.commands.cameras import record, run_capture
from recon.core.errors import OutputError, ReconError, SourceError
from recon.core.values import RectifiedCamera, StereoPair
from recon.io import atomic
from recon.io.trajectory import FRAMES, HEADER
from recon.rig import capture
from recon.rig.capture import CaptureFolder, RecordingSettings
from recon.sources.registry import open_source
from tests.scenery.patience import LONG_S
from tests.sources import drives

CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)
SMALL_CAMERA = RectifiedCamera(10.0, 5.5, 3.5, 5.5, 0.5, 12, 8)
"""Of the images of `FakeCamera`."""


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    rng = np.random.default_rng(5)
    return [
        StereoPair(*rng.integers(0, 256, (2, 32, 64), dtype=np.uint8), 0.1 * index, index)
        for index in range(12)
    ]


class FakeCamera:
    """A live camera whose frames come at given times; each shows the time it was taken."""

    def __init__(self, name: str, stamps_s: list[float], rate_hz: float = 10.0) -> None:
        self.name, self.live, self.rate_hz = name, True, rate_hz
        self.stamps_s, self.at, self.exposure = stamps_s, -1, 100.0
        self.grabbed: list[str] = []

    def grab(self) -> float | None:
        self.at += 1
        return self.stamps_s[self.at] if self.at < len(self.stamps_s) else None

    def retrieve(self) -> np.ndarray:
        return np.full((8, 12, 3), round(100 * self.stamps_s[self.at]) % 256, np.uint8)

    def lock(self, exposure: float | None) -> float | None:
        self.exposure = self.exposure if exposure is None else exposure
        return self.exposure

    def close(self) -> None: ...


@pytest.fixture(autouse=True)
def _no_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Record from the first frame on."""
    monkeypatch.setattr(capture, "_WARM_UP_FRAMES", 0)


def never() -> bool:
    return False


def test_two_videos_are_recorded_and_mapped_at_once(
    pairs: list[StereoPair], tmp_path: Path
) -> None:
    folder = drives.write_two_videos(pairs, CAMERA, tmp_path / "in")
    devices = [str(folder / "left.avi"), str(folder / "right.avi")]
    out = tmp_path / "out"
    calibration = folder / "calib.txt"
    summary = run_capture(devices, out, RecordingSettings(preview_every=4), calibration=calibration)
    assert summary["frames"] == 12
    assert summary["rate_hz"] == pytest.approx(10, rel=1e-3)
    assert summary["skew_max_ms"] == 0
    assert (out / "preview.jpg").is_file()
    assert json.loads((out / "capture.json").read_text()) == summary
    source = open_source(out)
    assert "frames.csv" in source.description
    for ours, truth in zip(source, pairs, strict=True):
        np.testing.assert_array_equal(ours.left[:, :, 0], truth.left)
        np.testing.assert_array_equal(ours.right[:, :, 0], truth.right)
        assert ours.timestamp_s == pytest.approx(truth.timestamp_s, abs=1e-6)


def test_one_device_with_both_views_is_halved(pairs: list[StereoPair], tmp_path: Path) -> None:
    video = drives.write_side_by_side(pairs, CAMERA, tmp_path / "in")
    run_capture([str(video)], tmp_path / "out", RecordingSettings(frames=5))
    drives.write_calib(tmp_path / "out", CAMERA)
    read = list(open_source(tmp_path / "out"))
    assert len(read) == 5
    np.testing.assert_array_equal(read[4].right[:, :, 0], pairs[4].right)


def test_skew_is_recorded(tmp_path: Path) -> None:
    times = [0.1 * k for k in range(8)]
    cameras = (FakeCamera("l", times), FakeCamera("r", [t + 0.003 for t in times]))
    summary = record(cameras, tmp_path, RecordingSettings(frames=8), None, never)
    assert summary["skew_mean_ms"] == pytest.approx(3)
    assert summary["gaps"] == 0
    rows = (tmp_path / FRAMES).read_text().splitlines()
    assert rows[3] == "left/000002.png,right/000002.png,0.200000,0.203000"


def test_a_frame_lost_by_one_camera_is_dropped_of_the_other(tmp_path: Path) -> None:
    times = [0.1 * k for k in range(10)]
    lossy = [t + 0.002 for t in times if round(10 * t) not in {3, 4}]
    cameras = (FakeCamera("l", times), FakeCamera("r", lossy))
    summary = record(cameras, tmp_path, RecordingSettings(frames=8), None, never)
    assert summary["skew_max_ms"] == pytest.approx(2)
    assert summary["gaps"] == 1
    drives.write_calib(tmp_path, SMALL_CAMERA)
    stamps = [frame.timestamp_s for frame in open_source(tmp_path).images]  # type: ignore[attr-defined]
    np.testing.assert_allclose(stamps, [t for t in times if round(10 * t) not in {3, 4}])


def test_the_exposure_of_the_left_camera_is_held_on_both_sides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "_WARM_UP_FRAMES", 4)
    times = [0.1 * k for k in range(10)]
    cameras = (FakeCamera("l", times), FakeCamera("r", times))
    cameras[1].exposure = 7.0
    summary = record(cameras, tmp_path, RecordingSettings(frames=3), None, never)
    assert summary["exposure_locked"] is True
    assert cameras[1].exposure == cameras[0].exposure == 100.0
    assert "0.400000" in (tmp_path / FRAMES).read_text().splitlines()[1]


def test_a_camera_that_goes_silent_is_reported_and_what_was_recorded_stays(tmp_path: Path) -> None:
    times = [0.1 * k for k in range(6)]
    cameras = (FakeCamera("l", times), FakeCamera("/dev/video2", times[:4]))
    with pytest.raises(SourceError, match="/dev/video2: camera gives no more frames"):
        record(cameras, tmp_path, RecordingSettings(), None, never)
    drives.write_calib(tmp_path, SMALL_CAMERA)
    assert len(open_source(tmp_path)) == 4


@pytest.mark.parametrize("victim", ["left", "right", "list"])
def test_a_full_disk_takes_the_pair_back_whole(
    pairs: list[StereoPair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, victim: str
) -> None:
    folder = drives.write_two_videos(pairs, CAMERA, tmp_path / "in")
    fill_the_disk(monkeypatch, victim)
    devices = [str(folder / "left.avi"), str(folder / "right.avi")]
    with pytest.raises(OutputError, match=r"(No space left on device).*disk"):
        run_capture(devices, tmp_path / "out", RecordingSettings())
    drives.write_calib(tmp_path / "out", CAMERA)
    read = list(open_source(tmp_path / "out"))
    assert len(read) == 5
    written = sorted(path.name for path in (tmp_path / "out").rglob("*.png"))
    assert written == sorted(2 * [f"{k:06d}.png" for k in range(5)])


def fill_the_disk(monkeypatch: pytest.MonkeyPatch, victim: str) -> None:
    """The sixth image of a side, or the sixth line, finds no room."""
    full = OSError(28, os.strerror(28))
    sync, write = atomic._sync, os.write

    def full_sync(path: Path) -> None:
        if path.name.endswith("-000005.png") and path.parent.name == victim:
            raise full
        sync(path)

    def full_write(handle: int, line: bytes) -> int:
        if line.startswith(b"left/000005") and victim == "list":
            write(handle, line[:9])  # the first part still fits
            raise full
        return write(handle, line)

    monkeypatch.setattr(atomic, "_sync", full_sync)
    monkeypatch.setattr(os, "write", full_write)


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(OutputError, match=r"folder is not empty.*--out"):
        CaptureFolder(tmp_path, "png")


@pytest.mark.parametrize(
    ("devices", "message"),
    [
        (["no_such_camera"], "no_such_camera: camera cannot be opened"),
        (["97"], "97: camera cannot be opened"),
    ],
)
def test_a_camera_that_is_not_there_is_one_line_and_leaves_no_folder(
    tmp_path: Path, devices: list[str], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ReconError, match=message) as caught:
        run_capture(devices, tmp_path / "out", RecordingSettings())
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""
    assert not (tmp_path / "out").exists()


def test_cameras_of_different_size_are_reported(pairs: list[StereoPair], tmp_path: Path) -> None:
    drives.write_video(tmp_path / "l.avi", [pair.left for pair in pairs])
    drives.write_video(tmp_path / "r.avi", [pair.right[:, :32] for pair in pairs])
    devices = [str(tmp_path / "l.avi"), str(tmp_path / "r.avi")]
    with pytest.raises(SourceError, match="left 64x32, right 32x32"):
        run_capture(devices, tmp_path / "out", RecordingSettings())


def wait_for(condition: Callable[[], bool], seconds: float = LONG_S) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.mark.slow
def test_interrupting_the_command_leaves_a_drive_and_exit_code_0(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    frame = rng.integers(0, 256, (240, 640), dtype=np.uint8)
    video = drives.write_video(tmp_path / "long.avi", [frame] * 400)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "recon", "capture", str(video), "--out", str(out), "--json"]
    done = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: (out / FRAMES).is_file() and len((out / FRAMES).read_text()) > len(HEADER))
    done.send_signal(signal.SIGINT)
    stdout, stderr = done.communicate()
    assert (done.returncode, stderr) == (0, "")
    frames = json.loads(stdout)["frames"]
    assert 0 < frames < 400
    drives.write_calib(out, RectifiedCamera(300.0, 159.5, 119.5, 159.5, 0.1, 320, 240))
    assert len(list(open_source(out))) == frames
    assert len(list(out.rglob("*.png"))) == 2 * frames
