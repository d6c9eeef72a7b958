from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from recon.commands.cameras import run_calibrate
from recon.commands.config import load_config
from recon.core.errors import CalibrationError, OutputError, ReconError, SourceError
from recon.core.values import StereoCalibration
from recon.core.values.board import parse_board
from recon.io.cameras.calibration import read_calibration
from recon.io.images.image import read_image, write_image
from recon.rig.calibrate.board_views import find_views
from recon.rig.calibrate.result import CalibrationForm, CalibrationRun, write_calibration
from recon.sources.image_names import pair_images
from recon.stereo.rectify.rectifier import Rectifier
from tests.scenery.boards import board_rig, place_boards, render_views
from tests.sources.drives import write_video

BOARD = parse_board("chess:9x6:25mm")


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine views of a board through a true rig; the right image of one is without the board."""
    folder, rig = tmp_path_factory.mktemp("board"), board_rig()
    pictures = render_views(rig, BOARD, place_boards(rig, BOARD, 9, seed=2))
    for number, (left, right) in enumerate(pictures):
        write_image(folder / f"left{number:02d}.png", left)
        write_image(folder / f"right{number:02d}.png", right if number != 4 else left[:] * 0 + 99)
    return folder


def calibrate(folder: Path, out: Path, form: str = "recon", board: str = "chess:9x6:25mm"):
    terms = ["calibration.radial_terms=2"] if form == "kalibr" else []
    sides = (str(folder / "left*.png"), str(folder / "right*.png"))
    return run_calibrate(
        *sides,
        parse_board(board),
        load_config(None, terms),
        file=out / "rig.yaml",
        form=form,  # type: ignore[arg-type]
        out=out / "report",
        threads=1,
    )


@pytest.fixture(scope="module")
def run(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> CalibrationRun:
    """A calibration whose figures, files and report several tests look at."""
    return calibrate(drawn, tmp_path_factory.mktemp("calibrated"))


def assert_true_rig(run: CalibrationRun) -> None:
    summary, rig = run.summary, board_rig()
    assert summary["stereo_rms_px"] < 0.15
    assert summary["epipolar_px"] < 0.1
    # Corners of rendered images are good to about 0.1 px, and eight views are few.
    assert summary["focal_px"] == pytest.approx(rig.left.matrix[0, 0], rel=0.01)
    assert summary["baseline_m"] == pytest.approx(rig.baseline_m, rel=0.005)
    assert (summary["views"], summary["views_used"]) == (9, 8)
    assert summary["pictures_without_board"] == ["right04.png"]
    assert any("right04.png" in line for line in summary["warnings"])


def assert_read_back(file: Path, run: CalibrationRun) -> None:
    read = read_calibration(file, 640, 480)
    assert isinstance(read, StereoCalibration)
    assert read.baseline_m == pytest.approx(run.fit.calibration.baseline_m, rel=1e-9)
    focal_px = run.summary["rectified_focal_px"]
    assert Rectifier(read).camera.focal_px == pytest.approx(focal_px, rel=1e-6)


def test_pictures_give_the_true_rig(run: CalibrationRun) -> None:
    written = json.loads((Path(run.summary["out"]) / "summary.json").read_text())
    assert written == json.loads(json.dumps(run.summary))
    assert_true_rig(run)
    assert_read_back(Path(run.summary["files"][0]), run)


@pytest.mark.parametrize("form", ["recon", "opencv", "ros"])
def test_the_rig_comes_back_from_every_format(
    run: CalibrationRun, tmp_path: Path, form: CalibrationForm
) -> None:
    assert_read_back(write_calibration(tmp_path / "rig.yaml", run, form)[0], run)


def test_pictures_give_the_true_rig_with_a_lens_that_kalibr_knows(
    drawn: Path, tmp_path: Path
) -> None:
    run = calibrate(drawn, tmp_path, "kalibr")
    assert_true_rig(run)
    assert_read_back(Path(run.summary["files"][0]), run)


def test_report_and_pictures_are_written(run: CalibrationRun) -> None:
    out = Path(run.summary["out"])
    names = {path.name for path in out.rglob("*.png")}
    assert {"coverage.png", "epipolar_raw.png", "epipolar_rectified.png"} <= names
    html = (out / "report.html").read_text()
    assert "Stereo calibration" in html
    # Eight views are too few to be sure of the forecast, however small it is.
    assert run.summary["verdict"] in ("usable", "repeat")
    assert f"Verdict: {run.summary['verdict']}" in html
    assert "No warnings" not in html
    assert run.summary["findings"][0]["text"] in html
    assert f"{run.summary['stereo_rms_px']:.3f} px" in html
    assert (out / "calibration.yaml").is_file()


def shrink(folder: Path) -> None:
    write_image(folder / "right01.png", np.full((240, 320), 90, np.uint8))


def lose(folder: Path) -> None:
    for number in range(1, 7):
        (folder / f"right0{number}.png").unlink()


def blank(folder: Path) -> None:
    for path in folder.iterdir():
        write_image(path, np.full((480, 640), 90, np.uint8))


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (shrink, SourceError, r"right01\.png: images differ in size \(got 320x240"),
        (lose, SourceError, r"most have no partner \(got 3 pairs of 9 left, 3 right; left01\.png"),
        (blank, CalibrationError, r"the board was not found in any image \(got 18 images"),
    ],
)
def test_what_is_wrong_is_one_clear_line_and_nothing_is_left(
    drawn: Path, tmp_path: Path, spoil, error: type[ReconError], message: str
) -> None:
    copy = Path(shutil.copytree(drawn, tmp_path / "copy"))
    spoil(copy)
    with pytest.raises(error, match=message) as caught:
        calibrate(copy, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_wrong_board_is_reported_with_the_true_size(drawn: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"does not have 8x6 inner corners \(got 9x6"):
        calibrate(drawn, tmp_path / "out", board="chess:8x6:25mm")


def test_a_board_without_a_size_gives_squares_and_says_so(drawn: Path, tmp_path: Path) -> None:
    run = calibrate(drawn, tmp_path, board="chess:9x6")
    assert run.summary["baseline_squares"] == pytest.approx(0.12 / 0.025, rel=0.01)
    assert run.summary["baseline_m"] == pytest.approx(run.summary["baseline_squares"])
    assert any("in squares" in line for line in run.summary["warnings"])


def test_a_charuco_board_of_the_older_pattern_is_found_out(tmp_path: Path) -> None:
    rig, older = board_rig(), parse_board("charuco:8x6:30mm:22mm:5x5_100:legacy")
    views = place_boards(rig, older, 2, seed=3)
    for number, pair in enumerate(render_views(rig, older, views)):
        for side, picture in zip(("left", "right"), pair, strict=True):
            write_image(tmp_path / f"{side}{number}.png", picture)
    pictures = pair_images(f"{tmp_path}/left*.png", f"{tmp_path}/right*.png")
    seen = find_views(pictures, parse_board("charuco:8x6:30mm:22mm:5x5_100"), 1)
    assert seen.board == older
    assert len(seen.views) == 2
    for view, placed in zip(seen.views, views, strict=True):
        left = view.seen[0]
        np.testing.assert_allclose(left.pixels, placed.left_px[left.numbers], atol=0.5)


def test_a_folder_for_a_calibration_file_is_refused(drawn: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").mkdir()
    with pytest.raises(OutputError, match="calibration file is a folder"):
        calibrate(drawn, tmp_path)


@pytest.mark.slow
def test_a_still_board_on_video_gives_the_forecast_of_one_image_each(
    drawn: Path, tmp_path: Path
) -> None:
    often = tmp_path / "often"
    often.mkdir()
    rng = np.random.default_rng(3)
    for path in drawn.iterdir():
        for number in range(3):
            fresh = read_image(path) + rng.normal(0, 1.0, (480, 640)) * (number > 0)
            copy = often / f"{path.stem}_{number}.png"
            write_image(copy, np.clip(np.rint(fresh), 0, 255).astype(np.uint8))
    once = calibrate(drawn, tmp_path / "a").summary
    thrice = calibrate(often, tmp_path / "b").summary
    assert (thrice["views_used"], len(thrice["views_repeated"])) == (8, 16)
    # Another draw of the sensor's noise in the corners: a spread from 8 views varies by a third.
    spread = "rotation_spread_deg"
    assert thrice[spread] == pytest.approx(once[spread], rel=0.35)
    assert any(finding["code"] == "repeats" for finding in thrice["findings"])


def test_an_image_without_a_partner_is_left_out_and_counted(drawn: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(drawn, copy)
    (copy / "right02.png").unlink()
    summary = calibrate(copy, tmp_path).summary
    assert (summary["views"], summary["views_used"]) == (8, 7)
    told = {finding["code"]: finding["text"] for finding in summary["findings"]}
    assert told["unpaired"] == "images without a partner, left out: 1 (left02.png)"


def film(drawn: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """A second of each view, with new noise in every image, and half a second of moving there."""
    rng, frames = np.random.default_rng(2), []
    for number in range(9):
        both = [read_image(drawn / f"{side}{number:02d}.png") for side in ("left", "right")]
        shifts = [0] * 10 + [40, 80, 120, 160, 200]
        for shift in shifts:
            moved = (
                np.roll(image, shift, axis=1) + rng.normal(0, 2, image.shape) for image in both
            )
            left, right = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in moved)
            frames.append((left, right))
    return frames


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["two videos", "side by side"])
def test_a_video_gives_one_view_for_each_place_where_the_board_stands_still(
    drawn: Path, tmp_path: Path, layout: str
) -> None:
    frames = film(drawn)
    if layout == "two videos":
        left = write_video(tmp_path / "left.mkv", [left for left, _ in frames])
        right = str(write_video(tmp_path / "right.mkv", [right for _, right in frames]))
    else:
        left, right = write_video(tmp_path / "both.mkv", [np.hstack(both) for both in frames]), None
    run = run_calibrate(str(left), right, BOARD, load_config(), out=tmp_path / "out")
    # In one of the nine places the right camera does not see the board.
    assert 9 <= run.summary["views"] <= 11
    assert run.summary["views_used"] == 8
    assert run.summary["baseline_m"] == pytest.approx(board_rig().baseline_m, rel=0.005)
    numbers = [int(path.stem[4:]) for path in (tmp_path / "out" / "views").glob("left*.png")]
    assert all(number % 15 <= 9 for number in numbers)


def test_one_video_and_one_folder_are_refused(tmp_path: Path) -> None:
    video = write_video(tmp_path / "left.mkv", [np.zeros((32, 32), np.uint8)] * 3)
    with pytest.raises(SourceError, match="two videos, or one video with both views"):
        run_calibrate(str(video), str(tmp_path), BOARD, load_config(), out=tmp_path / "out")
    with pytest.raises(SourceError, match="two videos, or one video with both views"):
        run_calibrate(str(tmp_path), None, BOARD, load_config(), out=tmp_path / "out")


@pytest.mark.real
def test_the_published_chessboard_pairs_calibrate_as_they_should(
    recon_data: Path, tmp_path: Path
) -> None:
    folder = recon_data / "calibration" / "opencv_chessboard"
    sides = (str(folder / "left*.jpg"), str(folder / "right*.jpg"))
    summary = run_calibrate(*sides, BOARD, load_config(), out=tmp_path / "out").summary
    assert summary["stereo_rms_px"] <= 0.45
    assert summary["baseline_squares"] == pytest.approx(3.34, abs=0.02)
    assert summary["epipolar_px"] <= 0.3
    assert (summary["views_used"], summary["views_repeated"]) == (13, [])


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.slow
def test_the_published_views_captured_five_times_have_the_same_forecast(
    recon_data: Path, tmp_path: Path
) -> None:
    folder = recon_data / "calibration" / "opencv_chessboard"
    for path in folder.glob("*.jpg"):
        for number in range(5):
            (tmp_path / f"{path.stem}_{number}.jpg").symlink_to(path)
    summaries = []
    for name, source in (("once", folder), ("five", tmp_path)):
        sides = (str(source / "left*.jpg"), str(source / "right*.jpg"))
        run = run_calibrate(*sides, BOARD, load_config(), out=tmp_path / name)
        summaries.append(run.summary)
    once, five = summaries
    assert five["rotation_spread_deg"] == pytest.approx(once["rotation_spread_deg"], rel=1e-6)
    # 0.12 degrees between the cameras, which is 5 % of the depth at 3.5 m.
    assert once["verdict"] == five["verdict"] != "good"
