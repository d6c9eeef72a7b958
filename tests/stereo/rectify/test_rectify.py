"""Rectification: matching pixels come to share their row; images become grey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from recon.core.errors import CalibrationError, ShapeError
from recon.core.geometry.projection import disparity_from_depth, unproject
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration, StereoPair
from recon.io.cameras.calibration import read_calibration
from recon.io.images.image import read_image
from recon.stereo.rectify.lens import project_raw, rays_of
from recon.stereo.rectify.rectifier import (
    GreyMode,
    RectificationSettings,
    Rectifier,
    plan_rectification,
    plan_turns,
    to_grey,
)

WIDTH, HEIGHT = 320, 240
LENS = np.array([-0.28, 0.09, 1e-3, -8e-4, 0.0])


def intrinsics(focal: float, cx: float, cy: float, lens: np.ndarray = LENS) -> CameraIntrinsics:
    matrix = np.array([[focal, 0, cx], [0, focal * 1.003, cy], [0, 0, 1]])
    return CameraIntrinsics(matrix, lens, WIDTH, HEIGHT)


def rig(
    rotation: tuple[float, float, float] = (0.02, -0.03, 0.015),
    translation: tuple[float, float, float] = (-0.12, 0.004, -0.003),
) -> StereoCalibration:
    T = make_transform(exp_so3(np.array(rotation)), np.array(translation))
    return StereoCalibration(intrinsics(260, 163, 117), intrinsics(255, 158, 124, 0.9 * LENS), T)


def pair(seed: int = 0, shape: tuple[int, ...] = (HEIGHT, WIDTH)) -> StereoPair:
    left, right = np.random.default_rng(seed).integers(0, 256, (2, *shape), dtype=np.uint8)
    return StereoPair(left, right, timestamp_s=1.5, index=4, name="000004.png")


def rays(camera: CameraIntrinsics, pixels: np.ndarray) -> np.ndarray:
    """float64 (N, 3), directions with z = 1 of raw pixels (N, 2)."""
    focal = camera.matrix[0, 0]
    plane = np.zeros_like(pixels)
    # Fixed point of the exact forward model: OpenCV's own inverse stops early.
    for _ in range(30):
        directions = np.concatenate([plane, np.ones((len(pixels), 1))], axis=1)
        plane += (pixels - raw_pixels(camera, directions)) / focal
    return np.concatenate([plane, np.ones((len(pixels), 1))], axis=1)


def raw_pixels(camera: CameraIntrinsics, xyz: np.ndarray) -> np.ndarray:
    """float64 (N, 2), where the lens puts points (N, 3)."""
    zero = np.zeros(3)
    return cv2.projectPoints(xyz, zero, zero, camera.matrix, camera.distortion)[0].reshape(-1, 2)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0, None])
def test_a_point_lies_on_one_row_and_its_disparity_gives_its_depth(alpha: float | None) -> None:
    calibration = rig()
    settings = RectificationSettings(alpha=alpha)
    camera, (left, right) = plan_rectification(calibration, settings)
    rng = np.random.default_rng(5)
    v, u = rng.integers(40, HEIGHT - 40, 200), rng.integers(80, WIDTH - 40, 200)
    raw_left = np.stack([left.map_x[v, u], left.map_y[v, u]], axis=1).astype(np.float64)
    xyz_left = rays(calibration.left, raw_left) * rng.uniform(0.8, 20, (200, 1))
    raw_right = raw_pixels(calibration.right, apply(calibration.T_right_left, xyz_left))
    # Along the row of the left pixel, find where the right map meets the column of the point …
    columns = np.array([
        np.interp(x, right.map_x[row], np.arange(WIDTH), left=np.nan, right=np.nan)
        for row, x in zip(v, raw_right[:, 0], strict=True)
    ])  # fmt: skip
    seen = np.isfinite(columns)
    assert seen.sum() > 150
    u, v, columns = u[seen], v[seen], columns[seen]
    # … there it must also meet its row.
    rows = [
        np.interp(c, np.arange(WIDTH), right.map_y[row]) for c, row in zip(columns, v, strict=True)
    ]
    np.testing.assert_allclose(rows, raw_right[seen, 1], rtol=0, atol=0.01)
    # A rotation keeps lengths, so the range tells the true disparity of the rectified pixel.
    range_m = np.linalg.norm(xyz_left[seen], axis=1)
    ray = np.linalg.norm(unproject(u, v, np.ones(len(u)), camera), axis=1)
    disparity = disparity_from_depth(range_m / ray, camera)
    np.testing.assert_allclose(u - columns, disparity, rtol=0, atol=0.01)


def striped(calibration: StereoCalibration, stripes: float) -> StereoPair:
    """Both raw views of a world whose grey depends on the epipolar plane alone."""
    T_left_right = invert(calibration.T_right_left)
    centre = T_left_right[:3, 3]
    across = np.cross(centre, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    forward = np.cross(across, centre / np.linalg.norm(centre))
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    images = []
    for camera, T in ((calibration.left, np.eye(4)), (calibration.right, T_left_right)):
        found = rays(camera, pixels) if camera.model == "pinhole" else rays_of(camera, pixels)
        directions = found @ T[:3, :3].T
        angle = np.arctan2(directions @ across, directions @ forward)
        grey = np.nan_to_num(128 + 100 * np.sin(angle * stripes), nan=0.0)
        images.append(np.rint(grey).astype(np.uint8).reshape(HEIGHT, WIDTH))
    return StereoPair(images[0], images[1])


# Rounding to a level, twice, and linear interpolation of the sine; 10 times that when raw.
@pytest.mark.parametrize(("fisheye", "limit", "stripes"), [(False, 2, 25), (True, 3, 12)])
def test_stripes_of_epipolar_planes_become_level_and_equal_in_both_images(
    fisheye: bool, limit: float, stripes: float
) -> None:
    calibration = fisheye_rig() if fisheye else rig()
    raw = striped(calibration, stripes)
    rectified = Rectifier(calibration).rectify(raw)
    spread = [image.astype(float).std(axis=1).max() for image in (rectified.left, rectified.right)]
    assert max(spread) < limit
    assert raw.left.astype(float).std(axis=1).max() > 20
    means = [image.mean(axis=1) for image in (rectified.left, rectified.right)]
    assert np.abs(means[0] - means[1]).max() < limit / 2
    assert np.ptp(means[0]) > 100


def test_a_rig_that_is_aligned_already_keeps_its_images() -> None:
    K = np.array([[250.0, 0, 160], [0, 250, 120], [0, 0, 1]])
    camera = CameraIntrinsics(K, np.zeros(0), WIDTH, HEIGHT)
    T = make_transform(np.eye(3), np.array([-0.1, 0, 0]))
    rectifier = Rectifier(StereoCalibration(camera, camera, T))
    rectified = rectifier.rectify(pair())
    assert rectifier.camera.baseline_m == pytest.approx(0.1)
    assert rectifier.camera.doffs_px == 0
    assert rectified.valid is not None
    assert rectified.valid.mean() > 0.99
    # OpenCV sizes the view by corners at -0.5: a quarter per cent of zoom at most.
    assert rectifier.camera.focal_px == pytest.approx(250, rel=0.005)


def test_alpha_0_leaves_only_pixels_with_a_source_and_alpha_1_keeps_all_sources() -> None:
    zoomed, whole = (Rectifier(rig(), RectificationSettings(alpha=alpha)) for alpha in (0, 1))
    assert zoomed.valid is not None
    assert whole.valid is not None
    assert zoomed.valid.mean() > 0.999
    assert 0.5 < whole.valid.mean() < 0.99
    assert whole.camera.focal_px < zoomed.camera.focal_px


def test_pixels_without_a_source_are_black_and_not_valid() -> None:
    white = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    rectified = Rectifier(rig(), RectificationSettings(alpha=1)).rectify(StereoPair(white, white))
    assert rectified.valid is not None
    assert (rectified.left[rectified.valid] == 255).all()
    # Only the seam, where interpolation mixes with black, is neither.
    assert (rectified.left[~rectified.valid] == 0).mean() > 0.9


@pytest.mark.parametrize("calibration", ["raw", "rectified"])
def test_colours_are_kept_beside_the_grey(calibration: str) -> None:
    rectifier = Rectifier(rig() if calibration == "raw" else Rectifier(rig()).camera)
    rectified = rectifier.rectify(pair(shape=(HEIGHT, WIDTH, 3)))
    assert rectified.left_rgb is not None
    assert rectified.right_rgb is not None
    assert rectified.left_rgb.shape == rectified.right_rgb.shape == (HEIGHT, WIDTH, 3)
    assert rectified.left.shape == rectified.right.shape == (HEIGHT, WIDTH)
    assert (rectified.timestamp_s, rectified.index) == (1.5, 4)


def test_rectified_input_passes_through_bit_by_bit() -> None:
    camera = RectifiedCamera(250, 160, 120, 165, 0.1, WIDTH, HEIGHT, ndisp=64)
    source = pair()
    rectifier = Rectifier(camera)
    rectified = rectifier.rectify(source)
    assert rectifier.camera is rectified.camera is camera
    np.testing.assert_array_equal(rectified.left, source.left)
    np.testing.assert_array_equal(rectified.right, source.right)
    assert rectified.valid is None
    assert rectified.left_rgb is None


@pytest.mark.parametrize("calibration", [rig(), RectifiedCamera(250, 1, 1, 1, 1, WIDTH, HEIGHT)])
def test_images_of_another_size_are_refused_with_both_sizes(
    calibration: StereoCalibration | RectifiedCamera,
) -> None:
    with pytest.raises(CalibrationError, match=r"000004\.png: .*got 320x200, expected 320x240"):
        Rectifier(calibration).rectify(pair(shape=(200, WIDTH)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"translation": (0.0, -0.1, 0.0)}, "not side by side.*vertical rig"),
        ({"translation": (-0.05, 0.1, 0.0)}, "not side by side"),
        ({"translation": (-0.05, 0.0, 0.1)}, "not side by side"),
        ({"translation": (0.12, 0.0, 0.0)}, "to the left.*swap left and right"),
        ({"rotation": (0, np.pi * 0.9, 0)}, "got 162 deg, expected at most 60 deg"),
        ({"rotation": (0, np.radians(61), 0)}, "got 61 deg, expected at most 60 deg"),
        ({"width_px": 640}, "got left 320x240, right 640x240"),
        ({"height_px": 200}, "got left 320x240, right 320x200"),
    ],
)
def test_rigs_that_are_no_left_and_right_are_refused(change: dict[str, Any], message: str) -> None:
    size = {name: change.pop(name) for name in ("width_px", "height_px") if name in change}
    calibration = rig(**change)
    calibration = replace(calibration, right=replace(calibration.right, **size))
    with pytest.raises(CalibrationError, match=message):
        Rectifier(calibration)


@pytest.mark.real
def test_corners_of_a_real_chessboard_share_their_rows(recon_data: Path) -> None:
    folder = recon_data / "calibration" / "opencv_chessboard"
    rectifier = Rectifier(read_calibration(folder / "intrinsics.yml", 640, 480))
    offsets = []
    for number in ("01", "05", "13"):
        raw = StereoPair(
            *(read_image(folder / f"{side}{number}.jpg") for side in ("left", "right"))
        )
        rectified = rectifier.rectify(raw)
        corners = [
            cv2.findChessboardCornersSB(np.array(image), (9, 6))
            for image in (rectified.left, rectified.right)
        ]
        if all(found for found, _ in corners):
            left, right = (points.reshape(-1, 2) for _, points in corners)
            offsets.append(left[:, 1] - right[:, 1])
            assert (left[:, 0] - right[:, 0] > 10).all()
    # The calibration itself has a reprojection error of 0.45 px.
    assert 0 < np.sqrt(np.mean(np.concatenate(offsets) ** 2)) < 0.5


def fisheye_rig(focal: float = 110.0) -> StereoCalibration:
    """Two lenses of about 160 degrees."""

    def camera(cx: float, cy: float) -> CameraIntrinsics:
        matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
        lens = np.array([0.02, -0.008, 0.002, -0.0004])
        return CameraIntrinsics(matrix, lens, WIDTH, HEIGHT, "fisheye")

    return StereoCalibration(camera(163, 117), camera(158, 124), rig().T_right_left)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0, None])
@pytest.mark.parametrize("mixed", [False, True])
def test_a_point_seen_by_fisheyes_lies_on_one_row_at_its_disparity(
    alpha: float | None, mixed: bool
) -> None:
    calibration = replace(fisheye_rig(), right=rig().right) if mixed else fisheye_rig()
    settings = RectificationSettings(alpha=alpha)
    turns = plan_turns(calibration, settings)
    xyz = np.random.default_rng(3).uniform((-1, -0.7, 0.7), (1, 0.7, 6), (300, 3))
    seen = []
    sides = (calibration.left, calibration.right)
    poses = (np.eye(4), calibration.T_right_left)
    rotations = (turns.R_left, turns.R_right)
    for camera, T, R, K in zip(sides, poses, rotations, turns.matrices, strict=True):
        rays_of_pixels = rays_of(camera, project_raw(camera, apply(T, xyz))) @ R.T
        seen.append((rays_of_pixels / rays_of_pixels[:, 2:]) @ K.T)
    left, right = seen
    np.testing.assert_allclose(left[:, 1], right[:, 1], rtol=0, atol=1e-6)
    depth_m = (xyz @ turns.R_left.T)[:, 2]
    np.testing.assert_allclose(
        left[:, 0] - right[:, 0], disparity_from_depth(depth_m, turns.camera), rtol=0, atol=1e-4
    )
    assert turns.camera.cx_px == turns.camera.cx_right_px


def test_alpha_0_of_a_fisheye_leaves_only_pixels_with_a_source() -> None:
    whole = Rectifier(fisheye_rig())
    assert whole.valid is not None
    assert whole.valid.all()
    wider = Rectifier(fisheye_rig(), RectificationSettings(alpha=1.0))
    assert wider.camera.focal_px < whole.camera.focal_px


def test_a_fisheye_beyond_a_half_space_still_gives_a_view_of_at_most_120_degrees_of_height() -> (
    None
):
    rectifier = Rectifier(fisheye_rig(focal=70.0), RectificationSettings(alpha=1.0))
    half_height = rectifier.camera.height_px / 2 / rectifier.camera.focal_px
    assert 1.0 < half_height < np.tan(np.radians(61))


def test_a_lens_that_folds_in_its_corners_is_not_zoomed_into_its_middle() -> None:
    """Eight coefficients fitted to boards in the middle turn back at 0.75 of the focal length."""
    folding = [-0.169, -0.0451, 3.7e-4, -3e-4, -0.0485, 0.1282, -0.0238, -0.0986]
    matrix = np.array([[336.0, 0, 243], [0, 336, 176], [0, 0, 1]])
    camera = CameraIntrinsics(matrix, np.array(folding), 480, 360)
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -0.12
    rectifier = Rectifier(StereoCalibration(camera, camera, T_right_left))
    assert 200 < rectifier.camera.focal_px < 500
    assert rectifier.valid is not None
    assert 0.8 < rectifier.valid.mean() <= 1.0
    corner = np.array([[0.0, 0.0]])
    assert np.isnan(rays_of(camera, corner)).all()


IMAGES = arrays(np.uint8, st.tuples(st.integers(1, 8), st.integers(1, 8), st.just(3)))
MODES: tuple[GreyMode, ...] = ("bt601", "mean", "paper")


@given(image=IMAGES)
def test_bt601_is_the_weighted_sum_of_the_norm(image: np.ndarray) -> None:
    exact = image @ np.array([0.299, 0.587, 0.114])
    # Rounding to nearest, and 1/2^14 steps of the weights in OpenCV's integers.
    assert np.abs(to_grey(image) - exact).max() < 0.52


@given(image=IMAGES)
def test_mean_is_rounded_and_paper_is_equation_6_as_printed_clipped_at_white(
    image: np.ndarray,
) -> None:
    np.testing.assert_array_equal(to_grey(image, "mean"), np.rint(image.mean(axis=2)))
    printed = image @ np.array([0.299, 0.587, 0.144])
    np.testing.assert_allclose(to_grey(image, "paper"), np.clip(printed, 0, 255), atol=0.5 + 1e-9)


def test_the_misprint_of_the_paper_makes_grey_brighter_and_white_clip() -> None:
    image = np.array([[[100, 100, 100], [255, 255, 255], [0, 0, 200]]], dtype=np.uint8)
    assert to_grey(image, "bt601").tolist() == [[100, 255, 23]]
    assert to_grey(image, "paper").tolist() == [[103, 255, 29]]


@pytest.mark.parametrize("mode", MODES)
def test_grey_read_only_and_strided_images_are_taken(mode: GreyMode) -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    strided = image[::2, ::-1]
    strided.flags.writeable = False
    grey = to_grey(strided, mode)
    np.testing.assert_array_equal(grey, to_grey(strided.copy(), mode))
    np.testing.assert_array_equal(to_grey(grey, mode), grey)


@pytest.mark.parametrize("image", [np.zeros((2, 2, 4), np.uint8), np.zeros((2, 2)), np.zeros(3)])
def test_what_is_no_image_is_refused(image: np.ndarray) -> None:
    with pytest.raises(ShapeError, match="image has the wrong dtype or shape"):
        to_grey(image)
