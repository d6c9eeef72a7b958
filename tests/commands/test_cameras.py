"""Rigs and their recordings: calibrate, rectify and capture."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recon.commands.cameras import record, run_calibrate, run_capture, run_rectify
from recon.commands.config import load_config
from recon.core.errors import CalibrationError, OutputError, ReconError, SourceError
from recon.core.values import RectifiedCamera, StereoPair
from recon.core.values.board import parse_board
from recon.io import atomic
from recon.io.cameras.calibration import read_calibration, write_recon_calibration
from recon.io.images.image import read_image, write_image
from recon.io.trajectory import FRAMES, HEADER
from recon.rig import capture
from recon.rig.calibrate.board_views import find_views
from recon.rig.calibrate.verdict import CalibrationResult, write_calibration
from recon.sources.images import pair_images
from recon.sources.registry import open_source
from recon.sources.synthetic import SyntheticSource
from recon.stereo.rectify.rectifier import Rectifier
from recon.street.settings import StreetScene
from tests.scenery.boards import board_rig, place_boards, render_views
from tests.scenery.patience import LONG_S
from tests.sources import drives

pytestmark = pytest.mark.usefixtures("blank_figures")
BOARD = parse_board("chess:9x6:25mm")
SIDES = ("left", "right")


def noisy(image: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    fresh = image + rng.normal(0, 1.0, image.shape) * sigma
    return np.clip(np.rint(fresh), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def drawn(tmp_path_factory):
    """Nine views of a board through a true rig; the right image of one is without the board."""
    folder, rig = tmp_path_factory.mktemp("board"), board_rig()
    pictures = render_views(rig, BOARD, place_boards(rig, BOARD, 9, seed=2))
    for number, (left, right) in enumerate(pictures):
        write_image(folder / f"left{number:02d}.png", left)
        write_image(folder / f"right{number:02d}.png", right if number != 4 else left[:] * 0 + 99)
    return folder


def calibrate(folder: Path, out: Path, board: str = "chess:9x6:25mm") -> CalibrationResult:
    sides = (str(folder / "left*.png"), str(folder / "right*.png"))
    files = {"file": out / "rig.yaml", "out": out / "report"}
    return run_calibrate(*sides, parse_board(board), load_config(), threads=1, **files)


@pytest.fixture(scope="module")
def run(drawn, tmp_path_factory):
    """A calibration whose figures, files and report several tests look at."""
    return calibrate(drawn, tmp_path_factory.mktemp("calibrated"))


def test_images_give_the_true_rig_with_its_report_which_comes_back_from_every_format(run, tmp_path):
    summary, rig = run.summary.to_json(), board_rig()
    written = json.loads((Path(summary["out"]) / "summary.json").read_text())
    assert written == json.loads(json.dumps(summary))
    assert summary["stereo_rms_px"] < 0.15
    assert summary["epipolar_px"] < 0.1
    # Corners of rendered images are good to about 0.1 px, and eight views are few.
    assert summary["focal_px"] == pytest.approx(rig.left.matrix[0, 0], rel=0.01)
    assert summary["baseline_m"] == pytest.approx(rig.baseline_m, rel=0.005)
    assert (summary["views"], summary["views_used"]) == (9, 8)
    assert summary["pictures_without_board"] == ["right04.png"]
    assert any("right04.png" in line for line in summary["warnings"])
    forms = [tmp_path / f"{form}.yaml" for form in ("recon", "opencv", "ros")]
    files = [write_calibration(path, run, path.stem)[0] for path in forms]
    for file in (summary["files"][0], *files):
        read = read_calibration(Path(file), 640, 480)
        assert read.baseline_m == pytest.approx(run.fit.calibration.baseline_m, rel=1e-9)
        focal_px = summary["rectified_focal_px"]
        assert Rectifier(read).camera.focal_px == pytest.approx(focal_px, rel=1e-6)
    out, summary = Path(run.summary.to_json()["out"]), run.summary.to_json()
    names = {path.name for path in out.rglob("*.png")}
    assert {"coverage.png", "epipolar_raw.png", "epipolar_rectified.png"} <= names
    # Eight views are too few to be sure of the forecast, however small it is.
    assert summary["verdict"] in ("usable", "repeat")
    html = (out / "report.html").read_text()
    assert f"Verdict: {summary['verdict']}" in html
    assert summary["findings"][0]["text"] in html
    assert (out / "calibration.yaml").is_file()


def shrink(folder: Path) -> None:
    write_image(folder / "right01.png", np.full((240, 320), 90, np.uint8))


def blank(folder: Path) -> None:
    for path in folder.iterdir():
        write_image(path, np.full((480, 640), 90, np.uint8))


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (shrink, SourceError, r"right01\.png: images differ in size \(got 320x240"),
        (blank, CalibrationError, r"the board was not found in any image \(got 18 images"),
    ],
)
def test_images_without_a_rig_are_refused_and_nothing_is_left(
    drawn, tmp_path, spoil, error, message
):
    copy = Path(shutil.copytree(drawn, tmp_path / "copy"))
    spoil(copy)
    with pytest.raises(error, match=message):
        calibrate(copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_board_without_a_size_gives_squares_and_says_so(drawn, tmp_path):
    run = calibrate(drawn, tmp_path, board="chess:9x6")
    assert run.summary.to_json()["baseline_squares"] == pytest.approx(0.12 / 0.025, rel=0.01)
    assert run.summary.to_json()["baseline_m"] == pytest.approx(
        run.summary.to_json()["baseline_squares"]
    )
    assert any("in squares" in line for line in run.summary.to_json()["warnings"])


def test_a_charuco_board_of_the_older_pattern_is_found_out(tmp_path):
    rig, older = board_rig(), parse_board("charuco:8x6:30mm:22mm:5x5_100:legacy")
    views = place_boards(rig, older, 2, seed=3)
    for number, pair in enumerate(render_views(rig, older, views)):
        for side, image in zip(SIDES, pair, strict=True):
            write_image(tmp_path / f"{side}{number}.png", image)
    images = pair_images(f"{tmp_path}/left*.png", f"{tmp_path}/right*.png")
    seen = find_views(images, parse_board("charuco:8x6:30mm:22mm:5x5_100"), 1)
    assert seen.board == older
    for view, placed in zip(seen.views, views, strict=True):
        left = view.seen[0]
        np.testing.assert_allclose(left.pixels, placed.left_px[left.numbers], atol=0.5)


def test_a_folder_for_a_calibration_file_is_refused(drawn, tmp_path):
    (tmp_path / "rig.yaml").mkdir()
    with pytest.raises(OutputError, match="calibration file is a folder"):
        calibrate(drawn, tmp_path)


def test_an_image_without_a_partner_is_left_out_and_counted(drawn, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(drawn, copy)
    (copy / "right02.png").unlink()
    summary = calibrate(copy, tmp_path).summary.to_json()
    assert (summary["views"], summary["views_used"]) == (8, 7)
    told = {finding["code"]: finding["text"] for finding in summary["findings"]}
    assert told["unpaired"] == "images without a partner, left out: 1 (left02.png)"


@pytest.mark.slow
def test_a_video_gives_one_view_for_each_place_where_the_board_stands_still(drawn, tmp_path):
    """A second of each view, with new noise in every image, and half a second of moving there."""
    rng, films = np.random.default_rng(2), []
    for number in range(9):
        both = np.hstack([read_image(drawn / f"{side}{number:02d}.png") for side in SIDES])
        for shift in [0] * 10 + [40, 80, 120, 160, 200]:
            moved = np.hstack([np.roll(image, shift, axis=1) for image in np.hsplit(both, 2)])
            films.append(noisy(moved, 2, rng))
    videos = [
        str(drives.write_video(tmp_path / f"{side}.mkv", [np.hsplit(one, 2)[n] for one in films]))
        for n, side in enumerate(SIDES)
    ]
    run = run_calibrate(*videos, BOARD, load_config(), out=tmp_path / "out")
    # In one of the nine places the right camera does not see the board.
    assert 9 <= run.summary.to_json()["views"] <= 11
    assert run.summary.to_json()["views_used"] == 8
    assert run.summary.to_json()["baseline_m"] == pytest.approx(board_rig().baseline_m, rel=0.005)
    numbers = [int(path.stem[4:]) for path in (tmp_path / "out" / "views").glob("left*.png")]
    assert all(number % 15 <= 9 for number in numbers)


def test_one_video_and_one_folder_are_refused(tmp_path):
    video = drives.write_video(tmp_path / "left.mkv", [np.zeros((32, 32), np.uint8)] * 3)
    for left, right in ((str(video), str(tmp_path)), (str(tmp_path), None)):
        with pytest.raises(SourceError, match="two videos, or one video with both views"):
            run_calibrate(left, right, BOARD, load_config(), out=tmp_path / "out")


@pytest.mark.real
def test_the_published_chessboard_pairs_calibrate_as_they_should(recon_data, tmp_path):
    folder = recon_data / "calibration" / "opencv_chessboard"
    sides = (str(folder / "left*.jpg"), str(folder / "right*.jpg"))
    summary = run_calibrate(*sides, BOARD, load_config(), out=tmp_path / "out").summary.to_json()
    assert summary["stereo_rms_px"] <= 0.45
    assert summary["baseline_squares"] == pytest.approx(3.34, abs=0.02)
    assert summary["epipolar_px"] <= 0.3
    assert (summary["views_used"], summary["views_repeated"]) == (13, [])


SMALL = StreetScene(frames=2, width_px=480, height_px=240, focal_px=280.0, smooth_edges=False)
WARP = np.array([[1.0, 0.04, -12], [-0.05, 1.02, 9], [4e-5, -3e-5, 1]])


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """Two pairs of the street; the right camera's are warped by one homography."""
    folder = tmp_path_factory.mktemp("street")
    source = SyntheticSource(SMALL)
    for pair in source:
        height, width = pair.left.shape[:2]
        write_image(folder / "left" / f"{pair.index}.png", pair.left)
        warped = cv2.warpPerspective(pair.right, WARP, (width, height))
        write_image(folder / "right" / f"{pair.index}.png", warped)
    return folder


def test_a_folder_is_rectified_by_its_features_and_says_up_to_scale(street, tmp_path):
    sides = (str(street / "left"), str(street / "right"))
    run_rectify(*sides, load_config(), out=tmp_path / "out", threads=1)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["up_to_scale"] is True
    assert summary["epipolar_error_px"] < 0.7
    assert any("no metres" in line for line in summary["warnings"])
    assert not (tmp_path / "out" / "calibration.yaml").exists()
    images = {f"{side}/{number}.png" for side in ("left", "right") for number in (0, 1)}
    for name in {*images, "homographies.yaml", "pictures/epipolar_raw.png"}:
        assert (tmp_path / "out" / name).is_file()
    source = SyntheticSource(SMALL)
    truth = source.disparity_truth(0).values
    v, u = np.nonzero(np.isfinite(truth))
    ones = np.ones(len(u))
    left = np.array(summary["H_left"]) @ np.stack([u, v, ones])
    right = np.array(summary["H_right"]) @ WARP @ np.stack([u - truth[v, u], v, ones])
    assert np.abs(left[1] / left[2] - right[1] / right[2]).mean() < 0.7


def test_a_calibration_gives_metric_pictures_and_none_of_rectified_ones(street, tmp_path):
    camera = RectifiedCamera(270, 240, 120, 240, 0.5, 480, 240)
    write_recon_calibration(tmp_path / "c.yaml", camera)
    sides, file = (str(street / "left"), str(street / "right")), tmp_path / "c.yaml"
    with pytest.raises(CalibrationError, match=r"c\.yaml: .*already rectified"):
        run_rectify(*sides, load_config(), calibration=file, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    height, width = read_image(street / "left" / "0.png").shape[:2]
    rig = board_rig("fisheye", width, height)
    write_recon_calibration(tmp_path / "rig.yaml", rig)
    rig_file, out = tmp_path / "rig.yaml", tmp_path / "out"
    sides = (str(street / "left" / "0.png"), str(street / "right" / "0.png"))
    run = run_rectify(*sides, load_config(), calibration=rig_file, out=out, threads=1)
    camera = read_calibration(tmp_path / "out" / "calibration.yaml", width, height)
    assert camera.baseline_m == pytest.approx(rig.baseline_m)
    assert run.summary.to_json()["up_to_scale"] is False
    assert read_image(tmp_path / "out" / "left" / "0.png").shape == (height, width, 3)


def test_blank_images_are_refused_with_what_would_help(tmp_path):
    for side in ("l", "r"):
        write_image(tmp_path / f"{side}.png", np.full((60, 80), 128, np.uint8))
    sides = (str(tmp_path / "l.png"), str(tmp_path / "r.png"))
    with pytest.raises(CalibrationError, match=r"l\.png: .*several pairs are needed.*--calib"):
        run_rectify(*sides, load_config(), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)
SMALL_CAMERA = RectifiedCamera(10.0, 5.5, 3.5, 5.5, 0.5, 12, 8)
"""Of the images of `FakeCamera`."""


@pytest.fixture(scope="module")
def pairs():
    rng = np.random.default_rng(5)
    return [
        StereoPair(*rng.integers(0, 256, (2, 32, 64), dtype=np.uint8), 0.1 * index, index)
        for index in range(12)
    ]


class FakeCamera:
    """A live camera whose frames come at given times; each shows the time it was taken."""

    def __init__(self, name: str, stamps_s: list[float], live: bool = True) -> None:
        self.name, self.live, self.rate_hz, self.closed = name, live, 10.0, False
        self.stamps_s, self.at, self.exposure = stamps_s, -1, 100.0

    def grab(self) -> float | None:
        self.at += 1
        return self.stamps_s[self.at] if self.at < len(self.stamps_s) else None

    def retrieve(self) -> np.ndarray:
        return np.full((8, 12, 3), round(100 * self.stamps_s[self.at]) % 256, np.uint8)

    def lock(self, exposure: float | None) -> float | None:
        self.exposure = self.exposure if exposure is None else exposure
        return self.exposure

    def close(self) -> None:
        self.closed = True


@pytest.fixture(autouse=True)
def _no_warm_up(monkeypatch):
    """Record from the first frame on."""
    monkeypatch.setattr(capture, "_WARM_UP_FRAMES", 0)


def recorded(folder: Path, left_s: list[float], right_s: list[float], frames: int) -> Any:
    cameras = FakeCamera("l", left_s), FakeCamera("/dev/video2", right_s)
    cameras[1].exposure = 7.0
    settings = capture.RecordingSettings(frames=frames)
    return cameras, record(cameras, folder, settings, None, lambda: False).to_json()


def test_two_videos_are_recorded_and_mapped_at_once(pairs, tmp_path):
    folder = drives.write_two_videos(pairs, CAMERA, tmp_path / "in")
    devices = [str(folder / "left.avi"), str(folder / "right.avi")]
    out = tmp_path / "out"
    calibration = folder / "calib.txt"
    summary = run_capture(
        devices, out, capture.RecordingSettings(preview_every=4), calibration=calibration
    ).to_json()
    assert (summary["frames"], summary["rate_hz"]) == (12, pytest.approx(10, rel=1e-3))
    assert summary["skew_max_ms"] == 0
    assert (out / "preview.jpg").is_file()
    assert json.loads((out / "capture.json").read_text()) == summary
    source = open_source(out)
    assert "frames.csv" in source.description
    for ours, truth in zip(source, pairs, strict=True):
        np.testing.assert_array_equal(ours.left[:, :, 0], truth.left)
        np.testing.assert_array_equal(ours.right[:, :, 0], truth.right)
        assert ours.timestamp_s == pytest.approx(truth.timestamp_s, abs=1e-6)


def test_one_device_with_both_views_is_halved(pairs, tmp_path):
    video = drives.write_side_by_side(pairs, CAMERA, tmp_path / "in")
    run_capture([str(video)], tmp_path / "out", capture.RecordingSettings(frames=5))
    drives.write_calib(tmp_path / "out", CAMERA)
    read = list(open_source(tmp_path / "out"))
    assert len(read) == 5
    np.testing.assert_array_equal(read[4].right[:, :, 0], pairs[4].right)


TIMES_S = [0.1 * k for k in range(10)]


def test_a_camera_that_does_not_open_is_named_and_the_other_one_closed(monkeypatch):
    opened, asked = [], []

    def make(device: str, size: object, rate_hz: object) -> FakeCamera:
        if device == "bad":
            raise SourceError("camera cannot be opened", where=device)
        asked.append((size, rate_hz))
        opened.append(FakeCamera(device, []))
        return opened[-1]

    monkeypatch.setattr(capture, "Camera", make)
    settings = capture.CaptureSettings(size_px=(640, 480), rate_hz=15)
    with pytest.raises(SourceError, match="bad"), capture.open_cameras(["good", "bad"], settings):
        pass
    assert (asked, [camera.closed for camera in opened]) == ([((640, 480), 15.0)], [True])
    with capture.open_cameras(["good"], capture.CaptureSettings()) as cameras:
        assert not cameras[0].closed
    assert asked[-1] == (None, None)


def test_pairs_are_nearest_in_time_and_end_when_asked(monkeypatch):
    late = [t + 0.003 for t in TIMES_S if t != TIMES_S[3]]  # the right camera loses a frame

    def taken(**limits: float) -> list[tuple[float, float]]:
        cameras = FakeCamera("left", TIMES_S, False), FakeCamera("right", late, False)
        settings = capture.RecordingSettings.parse(limits)
        return [
            (p.left_s, p.right_s) for p in capture.capture_pairs(cameras, settings, lambda: False)
        ]

    assert [left for left, _ in taken()] == [t for t in TIMES_S if t != TIMES_S[3]]
    assert max(right - left for left, right in taken()) < 0.004
    assert (len(taken(frames=4)), len(taken(seconds=0.55))) == (4, 5)
    monkeypatch.undo()
    cameras = FakeCamera("left", 2 * TIMES_S), FakeCamera("right", 2 * TIMES_S)
    assert capture.warm_up(cameras, capture.CaptureSettings(lock_exposure=False)) is False
    assert cameras[0].at == 14


def test_a_frame_lost_by_one_camera_is_dropped_of_the_other(tmp_path):
    kept = [t for t in TIMES_S if round(10 * t) not in {3, 4}]
    _, summary = recorded(tmp_path, TIMES_S, [t + 0.002 for t in kept], 8)
    assert (summary["skew_max_ms"], summary["skew_mean_ms"]) == (pytest.approx(2), pytest.approx(2))
    assert summary["gaps"] == 1
    drives.write_calib(tmp_path, SMALL_CAMERA)
    stamps = [frame.timestamp_s for frame in open_source(tmp_path).images]
    np.testing.assert_allclose(stamps, kept)


def test_the_exposure_of_the_left_camera_is_held_on_both_sides(tmp_path, monkeypatch):
    monkeypatch.setattr(capture, "_WARM_UP_FRAMES", 4)
    (left, right), summary = recorded(tmp_path, TIMES_S, TIMES_S, 3)
    assert summary["exposure_locked"] is True
    assert right.exposure == left.exposure == 100.0
    assert "0.400000" in (tmp_path / FRAMES).read_text().splitlines()[1]


def test_a_camera_that_goes_silent_is_reported_and_what_was_recorded_stays(tmp_path):
    with pytest.raises(SourceError, match="/dev/video2: camera gives no more frames"):
        recorded(tmp_path, TIMES_S, TIMES_S[:4], 10)
    drives.write_calib(tmp_path, SMALL_CAMERA)
    assert len(open_source(tmp_path)) == 4


@pytest.mark.parametrize("victim", ["left", "right", "list"])
def test_a_full_disk_takes_the_pair_back_whole(pairs, tmp_path, monkeypatch, victim):
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

    folder = drives.write_two_videos(pairs, CAMERA, tmp_path / "in")
    monkeypatch.setattr(atomic, "_sync", full_sync)
    monkeypatch.setattr(os, "write", full_write)
    devices = [str(folder / "left.avi"), str(folder / "right.avi")]
    with pytest.raises(OutputError, match=r"(No space left on device).*disk"):
        run_capture(devices, tmp_path / "out", capture.RecordingSettings())
    drives.write_calib(tmp_path / "out", CAMERA)
    assert len(list(open_source(tmp_path / "out"))) == 5
    written = sorted(path.name for path in (tmp_path / "out").rglob("*.png"))
    assert written == sorted(2 * [f"{k:06d}.png" for k in range(5)])


def test_a_folder_that_holds_something_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(OutputError, match=r"folder is not empty.*--out"):
        capture.CaptureFolder(tmp_path, "png")


@pytest.mark.parametrize("device", ["no_such_camera", "97"])
def test_a_camera_that_is_not_there_is_one_line_and_leaves_no_folder(tmp_path, device, capfd):
    with pytest.raises(ReconError, match=f"{device}: camera cannot be opened"):
        run_capture([device], tmp_path / "out", capture.RecordingSettings())
    assert capfd.readouterr().err == ""
    assert not (tmp_path / "out").exists()


def test_cameras_of_different_size_are_reported(pairs, tmp_path):
    drives.write_video(tmp_path / "l.avi", [pair.left for pair in pairs])
    drives.write_video(tmp_path / "r.avi", [pair.right[:, :32] for pair in pairs])
    devices = [str(tmp_path / "l.avi"), str(tmp_path / "r.avi")]
    with pytest.raises(SourceError, match="left 64x32, right 32x32"):
        run_capture(devices, tmp_path / "out", capture.RecordingSettings())


@pytest.mark.slow
def test_interrupting_the_command_leaves_a_drive_and_exit_code_0(tmp_path):
    rng = np.random.default_rng(1)
    frame = rng.integers(0, 256, (240, 640), dtype=np.uint8)
    video = drives.write_video(tmp_path / "long.avi", [frame] * 400)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "recon", "capture", str(video), "--out", str(out), "--json"]
    done = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + LONG_S
    while not (out / FRAMES).is_file() or len((out / FRAMES).read_text()) <= len(HEADER):
        assert time.monotonic() < until
        time.sleep(0.05)
    done.send_signal(signal.SIGINT)
    stdout, stderr = done.communicate()
    assert (done.returncode, stderr) == (0, "")
    frames = json.loads(stdout)["frames"]
    assert 0 < frames < 400
    drives.write_calib(out, RectifiedCamera(300.0, 159.5, 119.5, 159.5, 0.1, 320, 240))
    assert (len(list(open_source(out))), len(list(out.rglob("*.png")))) == (frames, 2 * frames)
