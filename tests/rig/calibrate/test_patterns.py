"""Boards of every kind are found where they are, as they are drawn, and in parts."""

from functools import cache

import cv2
import numpy as np
import pytest

from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.core.values import CameraIntrinsics
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.board import CalibrationBoard, parse_board
from recon.rig.board_sheet import write_board
from recon.rig.calibrate.bundle import Sighting, View
from recon.rig.calibrate.patterns import charuco, dark_polygons, find_board
from recon.rig.calibrate.stereo import calibrate_stereo
from recon.rig.settings import CalibrationSettings
from recon.stereo.rectify.lens import project_raw
from tests.scenery.boards import BoardRenderer, board_rig, place_boards

APRIL = "aprilgrid:4x3:60mm:0.3"
CIRCLES = "circles:7x6:30mm:14mm"
ACIRCLES = "acircles:4x9:20mm:14mm"
CHARUCO = "charuco:8x11:24mm:19mm:4x4_100"
BLUR_PX, NOISE_DN = 0.7, 3.0


def wide_camera() -> CameraIntrinsics:
    """140 degrees across, as of a fisheye lens."""
    matrix = np.array([[262.0, 0, 322.0], [0, 262.0, 236.0], [0, 0, 1]])
    return CameraIntrinsics(matrix, np.array([0.03, -0.012, 0.004, -6e-4]), 640, 480, "fisheye")


def facing(board: CalibrationBoard, x: float, y: float, tilt: float, away: float) -> Float64:
    """Pose of a board whose middle is at x, y, relative to the distance, and tilted."""
    R = exp_so3(np.array([0.3 * tilt, tilt, 0.1]))
    centre = away * max(board.size_m) * np.array([x, y, 1.0])
    return make_transform(R, centre - R @ board.corners_m.mean(axis=0))


@cache
def seen_wide(text: str, blur_px: float = BLUR_PX) -> list[tuple[UInt8, Float64]]:
    """Images of a board through the wide lens with noise, and the true pixels of its corners."""
    camera, board = wide_camera(), parse_board(text)
    renderer, rng = BoardRenderer(camera, board), np.random.default_rng(4)
    shown = []
    for x, y, tilt, away in [(0, 0, 0.3, 0.6), (0.5, 0.3, -0.1, 0.6), (-0.6, -0.2, 0.1, 0.6)]:
        T = facing(board, x, y, tilt, away)
        blurred = cv2.GaussianBlur(renderer.render(T).astype(np.float64), (0, 0), blur_px)
        noisy = blurred + rng.normal(0, NOISE_DN, blurred.shape)
        grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        shown.append((grey, project_raw(camera, apply(T, board.corners_m))))
    return shown


def rms(errors: list[Float64]) -> float:
    return float(np.sqrt((np.concatenate(errors) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("text", [APRIL, f"{APRIL}:thin"])
def test_tags_are_found_through_a_wide_lens_to_a_tenth_of_a_pixel(text):
    board, errors = parse_board(text), []
    for grey, truth in seen_wide(text):
        inside = ((truth > 3) & (truth < np.array(grey.shape[::-1]) - 4)).all(axis=1)
        found = find_board(grey, board)
        errors.append(found.pixels - truth[found.numbers])
        assert len(found.numbers) >= 0.9 * inside.sum()
    # Where the border has one bit, windows are half as wide.
    assert rms(errors) < (0.15 if board.legacy else 0.1)


def test_small_and_blurred_tags_are_found_where_opencv_sees_none():
    """Tags of 20 px, two pixels a bit, blurred by 1.3: a sheet of kalibr at 1.7 m from a EuRoC."""
    distortion = np.array([-0.283, 0.0739, 1.9e-4, 1.8e-5])
    matrix = np.array([[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]])
    camera = CameraIntrinsics(matrix, distortion, 752, 480)
    board = parse_board("aprilgrid:6x6:88mm:0.3")
    T = facing(board, 0.1, -0.05, 0.35, 1.75 / max(board.size_m))
    blurred = cv2.GaussianBlur(BoardRenderer(camera, board).render(T), (0, 0), 1.3)
    noise = np.random.default_rng(2).normal(0, NOISE_DN, blurred.shape)
    grey = np.clip(np.rint(blurred + noise), 0, 255).astype(np.uint8)
    truth, found = project_raw(camera, apply(T, board.corners_m)), find_board(grey, board)
    assert len(found.numbers) >= 0.9 * len(truth)
    assert rms([found.pixels - truth[found.numbers]]) < 0.25


def test_a_part_of_the_tags_is_enough_and_a_tag_shown_twice_is_kept_once():
    board, (grey, truth) = parse_board(APRIL), seen_wide(APRIL)[0]
    covered = grey.copy()
    covered[:, : int(np.median(truth[:, 0]))] = 90
    covered[:60, :60] = cv2.resize(  # another sheet with tag 0 lies about
        cv2.copyMakeBorder(
            cv2.aruco.generateImageMarker(
                cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11), 0, 40, None, 2
            ),
            10, 10, 10, 10, cv2.BORDER_CONSTANT, value=255,
        ),
        (60, 60),
    )  # fmt: skip
    found = find_board(covered, board)
    assert 8 <= len(found.numbers) < len(truth)
    assert len(set(found.numbers)) == len(found.numbers)
    # The squares at a few corners are half covered.
    apart = np.linalg.norm(found.pixels - truth[found.numbers], axis=1)
    assert np.quantile(apart, 0.9) < 0.2


@pytest.mark.parametrize("blur_px", [0.5, 1.2])
def test_charuco_corners_are_no_noisier_than_those_of_opencv(blur_px):
    board, ours, theirs = parse_board(CHARUCO), [], []
    for grey, truth in seen_wide(CHARUCO, blur_px):
        corners, numbers, *_ = cv2.aruco.CharucoDetector(charuco(board)).detectBoard(grey)
        found = find_board(grey, board)
        assert found is not None
        np.testing.assert_array_equal(found.numbers, numbers.ravel())
        ours.append(found.pixels - truth[found.numbers])
        theirs.append(corners.reshape(-1, 2) - truth[found.numbers])
    assert rms(ours) < rms(theirs)


@pytest.mark.parametrize("text", [CIRCLES, ACIRCLES])
def test_circles_are_found_and_calibrate_a_rig_whose_centres_are_not_centroids(text):
    board, rig = parse_board(text), board_rig()
    cameras, views = (rig.left, rig.right), []
    renderers = [BoardRenderer(camera, board) for camera in cameras]
    for number, placed in enumerate(place_boards(rig, board, 8, seed=2)):
        poses = placed.T_left_board, rig.T_right_left @ placed.T_left_board
        sightings, truth = [], (placed.left_px, placed.right_px)
        for renderer, T, pixels in zip(renderers, poses, truth, strict=True):
            found = find_board(renderer.render(T, 2.0, number), board)
            if found is not None and np.abs(found.pixels - pixels).max() > 5:  # turned
                found = Sighting(found.numbers, found.board_m, found.pixels[::-1])
            sightings.append(found)
        if all(sightings):
            views.append(View(f"v{number}", tuple(sightings)))
    assert len(views) >= 6
    settings = CalibrationSettings(radial_terms=2)
    plain = calibrate_stereo(views, (640, 480), settings)
    fit = calibrate_stereo(views, (640, 480), settings, board.marker_m)
    assert fit.rms_px < min(plain.rms_px, 0.1)
    assert abs(fit.calibration.baseline_m - rig.baseline_m) < 0.003 * rig.baseline_m


@pytest.mark.parametrize("text", ["aprilgrid:4x3:35mm:0.3", "circles:7x6:20mm:10mm", ACIRCLES])
def test_a_sheet_shows_its_board_in_its_size(tmp_path, text):
    board = parse_board(text)
    drawn = write_board(tmp_path / "b.png", board, dpi=100)
    grey = cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_GRAYSCALE)
    found = find_board(grey, board)
    assert len(found.numbers) == len(board.corners_m)
    H, _ = cv2.findHomography(1e3 * found.board_m[:, :2], found.pixels * 25.4 / drawn.dpi)
    # Lengths of the print are those of the board; half a pixel is 0.13 mm.
    mapped = cv2.perspectiveTransform(1e3 * board.corners_m[None, :, :2], H)[0]
    apart = np.linalg.norm(mapped[0] - mapped[-1])
    assert apart == pytest.approx(
        1e3 * np.linalg.norm(board.corners_m[0] - board.corners_m[-1]), abs=0.1
    )
    assert np.ptp(dark_polygons(board), axis=(0, 1)) == pytest.approx(board.size_m)


def test_tags_lie_as_kalibr_draws_them():
    # Tag 0 is at the lower left, and its bits run from its upper left: 0xd5d628584 of tag36h11.
    board = parse_board("aprilgrid:2x2:100mm:0.5")
    outlines = dark_polygons(board)
    low, high = outlines.min(axis=1), outlines.max(axis=1)
    middles = np.array(
        [[30 + 10 * c - 5, -100 + 30 + 10 * r - 5] for r in range(6) for c in range(6)]
    )
    middles = 1e-3 * middles
    dark = ((middles[:, None] > low) & (middles[:, None] < high)).all(axis=2).any(axis=1)
    assert "".join("01"[not d] for d in dark) == f"{0xD5D628584:036b}"
