"""Lenses, rectification, and features that show what is no rectified pair."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from recon.core.errors import CalibrationError, ShapeError
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import (
    CameraIntrinsics,
    LensModel,
    RectifiedCamera,
    RectifiedPair,
    StereoCalibration,
    StereoPair,
)
from recon.core.values.camera import disparity_from_depth
from recon.io.cameras.calibration import read_calibration
from recon.io.images.image import read_image
from recon.stereo.rectify import features
from recon.stereo.rectify.lens import project_raw, project_with_jacobian, rays_of
from recon.stereo.rectify.rectifier import RectificationSettings, Rectifier, plan_turns, to_grey

WIDTH, HEIGHT = 320, 240
LENS = np.array([-0.28, 0.09, 1e-3, -8e-4, 0.0])


def intrinsics(focal: float, cx: float, cy: float, lens: np.ndarray = LENS) -> CameraIntrinsics:
    matrix = np.array([[focal, 0, cx], [0, focal * 1.003, cy], [0, 0, 1]])
    return CameraIntrinsics(matrix, lens, WIDTH, HEIGHT)


def rig(rotation=(0.02, -0.03, 0.015), translation=(-0.12, 0.004, -0.003)):
    T = make_transform(exp_so3(np.array(rotation)), np.array(translation))
    return StereoCalibration(intrinsics(260, 163, 117), intrinsics(255, 158, 124, 0.9 * LENS), T)


def pair(seed: int = 0, shape: tuple[int, ...] = (HEIGHT, WIDTH)) -> StereoPair:
    left, right = np.random.default_rng(seed).integers(0, 256, (2, *shape), dtype=np.uint8)
    return StereoPair(left, right, timestamp_s=1.5, index=4, name="000004.png")


def striped(calibration: StereoCalibration, stripes: float) -> StereoPair:
    """Both raw views of a world whose grey depends on the epipolar plane alone."""
    T_left_right = invert(calibration.T_right_left)
    centre = T_left_right[:3, 3]
    across = np.cross(centre, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    forward = np.cross(across, centre / np.linalg.norm(centre))
    pixels = np.stack(np.indices((HEIGHT, WIDTH))[::-1], axis=-1).reshape(-1, 2)
    images = []
    for camera, T in ((calibration.left, np.eye(4)), (calibration.right, T_left_right)):
        directions = rays_of(camera, pixels) @ T[:3, :3].T
        angle = np.arctan2(directions @ across, directions @ forward)
        grey = np.nan_to_num(128 + 100 * np.sin(angle * stripes), nan=0.0)
        images.append(np.rint(grey).astype(np.uint8).reshape(HEIGHT, WIDTH))
    return StereoPair(images[0], images[1])


# Rounding to a level, twice, and linear interpolation of the sine; 10 times that when raw.
@pytest.mark.parametrize(("fisheye", "limit", "stripes"), [(False, 2, 25), (True, 3, 12)])
def test_stripes_of_epipolar_planes_become_level_and_equal_in_both_images(fisheye, limit, stripes):
    calibration = fisheye_rig() if fisheye else rig()
    raw = striped(calibration, stripes)
    rectified = Rectifier(calibration).rectify(raw)
    spread = [image.astype(float).std(axis=1).max() for image in (rectified.left, rectified.right)]
    assert max(spread) < limit
    assert raw.left.astype(float).std(axis=1).max() > 20
    means = [image.mean(axis=1) for image in (rectified.left, rectified.right)]
    assert np.abs(means[0] - means[1]).max() < limit / 2
    assert np.ptp(means[0]) > 100


def test_an_aligned_rig_keeps_its_images_and_rectified_input_passes_bit_by_bit():
    K = np.array([[250.0, 0, 160], [0, 250, 120], [0, 0, 1]])
    camera = CameraIntrinsics(K, np.zeros(0), WIDTH, HEIGHT)
    T = make_transform(np.eye(3), np.array([-0.1, 0, 0]))
    rectifier = Rectifier(StereoCalibration(camera, camera, T))
    assert (rectifier.camera.baseline_m, rectifier.camera.doffs_px) == (pytest.approx(0.1), 0)
    assert rectifier.valid.mean() > 0.99
    # OpenCV sizes the view by corners at -0.5: a quarter per cent of zoom at most.
    assert rectifier.camera.focal_px == pytest.approx(250, rel=0.005)
    camera = RectifiedCamera(250, 160, 120, 165, 0.1, WIDTH, HEIGHT, ndisp=64)
    source = StereoPair(*(cv2.blur(one, (5, 5)) for one in (pair().left, pair().right)))
    rectified = Rectifier(camera).rectify(source)
    assert rectified.camera is camera
    np.testing.assert_array_equal(rectified.left, source.left)
    np.testing.assert_array_equal(rectified.right, source.right)
    assert rectified.valid is rectified.left_rgb is None


def test_alpha_0_leaves_only_pixels_with_a_source_and_alpha_1_keeps_all_sources():
    for calibration, least in ((rig(), 0.999), (fisheye_rig(), 1.0)):
        zoomed, whole = (Rectifier(calibration, RectificationSettings(alpha=a)) for a in (0, 1))
        assert zoomed.valid.mean() >= least
        assert whole.camera.focal_px < zoomed.camera.focal_px
    whole = Rectifier(rig(), RectificationSettings(alpha=1))
    assert 0.5 < whole.valid.mean() < 0.99
    white = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    rectified = whole.rectify(StereoPair(white, white))
    assert (rectified.left[whole.valid] == 255).all()
    # Only the seam, where interpolation mixes with black, is neither.
    assert (rectified.left[~whole.valid] == 0).mean() > 0.9


@pytest.mark.parametrize("calibration", ["raw", "rectified"])
def test_colours_are_kept_beside_the_grey(calibration):
    rectifier = Rectifier(rig() if calibration == "raw" else Rectifier(rig()).camera)
    rectified = rectifier.rectify(pair(shape=(HEIGHT, WIDTH, 3)))
    assert rectified.left_rgb.shape == rectified.right_rgb.shape == (HEIGHT, WIDTH, 3)
    assert rectified.left.shape == rectified.right.shape == (HEIGHT, WIDTH)
    assert (rectified.timestamp_s, rectified.index) == (1.5, 4)


def test_images_of_another_size_are_refused_with_both_sizes():
    for calibration in (rig(), RectifiedCamera(250, 1, 1, 1, 1, WIDTH, HEIGHT)):
        with pytest.raises(CalibrationError, match=r"000004\.png: .*got 320x200, expected 320x240"):
            Rectifier(calibration).rectify(pair(shape=(200, WIDTH)))


@pytest.mark.parametrize(
    ("change", "size", "message"),
    [
        ({"translation": (0.0, -0.1, 0.0)}, {}, "not side by side.*vertical rig"),
        ({"translation": (-0.05, 0.0, 0.1)}, {}, "not side by side"),
        ({"translation": (0.12, 0.0, 0.0)}, {}, "to the left.*swap left and right"),
        ({"rotation": (0, np.radians(61), 0)}, {}, "got 61 deg, expected at most 60 deg"),
        ({}, {"width_px": 640}, "got left 320x240, right 640x240"),
        ({}, {"height_px": 200}, "got left 320x240, right 320x200"),
    ],
)
def test_rigs_that_are_no_left_and_right_are_refused(change, size, message):
    calibration = rig(**change)
    calibration = replace(calibration, right=replace(calibration.right, **size))
    with pytest.raises(CalibrationError, match=message):
        Rectifier(calibration)


@pytest.mark.real
def test_corners_of_a_real_chessboard_share_their_rows(recon_data):
    folder = recon_data / "calibration" / "opencv_chessboard"
    rectifier = Rectifier(read_calibration(folder / "intrinsics.yml", 640, 480))
    offsets = []
    for number in ("01", "05", "13"):
        raw = [read_image(folder / f"{side}{number}.jpg") for side in ("left", "right")]
        rectified = rectifier.rectify(StereoPair(*raw))
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


def fisheye_rig() -> StereoCalibration:
    def camera(cx: float, cy: float) -> CameraIntrinsics:
        matrix = np.array([[110.0, 0, cx], [0, 110, cy], [0, 0, 1]])
        lens = np.array([0.02, -0.008, 0.002, -0.0004])
        return CameraIntrinsics(matrix, lens, WIDTH, HEIGHT, "fisheye")

    return StereoCalibration(camera(163, 117), camera(158, 124), rig().T_right_left)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0, None])
@pytest.mark.parametrize("lenses", ["pinhole", "fisheye", "mixed"])
def test_points_lie_on_one_row_at_their_disparity(alpha, lenses):
    calibration = rig() if lenses == "pinhole" else fisheye_rig()
    if lenses == "mixed":
        calibration = replace(calibration, right=rig().right)
    turns = plan_turns(calibration, RectificationSettings(alpha=alpha))
    xyz = np.random.default_rng(3).uniform((-1, -0.7, 0.7), (1, 0.7, 6), (300, 3))
    xyz[:, :2] *= np.minimum(1, xyz[:, 2:] / 2)
    left_px = project_raw(calibration.left, xyz)
    right_px = project_raw(calibration.right, apply(calibration.T_right_left, xyz))
    left, right = turns.place(calibration, left_px), turns.place(calibration, right_px, right=True)
    np.testing.assert_allclose(left[:, 1], right[:, 1], rtol=0, atol=1e-6)
    disparity = disparity_from_depth((xyz @ turns.R_left.T)[:, 2], turns.camera)
    np.testing.assert_allclose(left[:, 0] - right[:, 0], disparity, rtol=0, atol=1e-4)
    assert turns.camera.cx_px == turns.camera.cx_right_px


def test_lenses_that_fold_in_corners_and_rays_at_ninety_degrees_give_sane_views():
    # Eight coefficients fitted to boards in the middle turn back at 0.75 of the focal length.
    folding = [-0.169, -0.0451, 3.7e-4, -3e-4, -0.0485, 0.1282, -0.0238, -0.0986]
    matrix = np.array([[336.0, 0, 243], [0, 336, 176], [0, 0, 1]])
    camera = CameraIntrinsics(matrix, np.array(folding), 480, 360)
    T_right_left = make_transform(np.eye(3), np.array([-0.12, 0, 0]))
    rectifier = Rectifier(StereoCalibration(camera, camera, T_right_left))
    assert 200 < rectifier.camera.focal_px < 500
    assert 0.8 < rectifier.valid.mean() <= 1.0
    assert np.isnan(rays_of(camera, np.array([[0.0, 0.0]]))).all()
    camera = lens("fisheye", np.array([100.0, 100, 320, 240, 0, 0, 0, 0]))
    rays = rays_of(camera, np.array([[470, 240], [490, 240]]))  # at 1.5 and 1.7 radians
    assert np.isfinite(rays).any(axis=1).tolist() == [True, False]


IMAGES = arrays(np.uint8, st.tuples(st.integers(1, 8), st.integers(1, 8), st.just(3)))


@given(image=IMAGES)
def test_grey_is_the_sum_of_the_norm_the_mean_or_equation_6_as_printed(image):
    exact = image @ np.array([0.299, 0.587, 0.114])
    # Rounding to nearest, and 1/2^14 steps of the weights in OpenCV's integers.
    assert np.abs(to_grey(image) - exact).max() < 0.52
    np.testing.assert_array_equal(to_grey(image, "mean"), np.rint(image.mean(axis=2)))
    printed = image @ np.array([0.299, 0.587, 0.144])
    np.testing.assert_allclose(to_grey(image, "paper"), np.clip(printed, 0, 255), atol=0.5 + 1e-9)


@pytest.mark.parametrize("mode", ["bt601", "mean", "paper"])
def test_grey_read_only_and_strided_images_are_taken_and_others_refused(mode):
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    strided = image[::2, ::-1]
    strided.flags.writeable = False
    grey = to_grey(strided, mode)
    np.testing.assert_array_equal(grey, to_grey(strided.copy(), mode))
    np.testing.assert_array_equal(to_grey(grey, mode), grey)
    for wrong in (np.zeros((2, 2, 4), np.uint8), np.zeros((2, 2)), np.zeros(3)):
        with pytest.raises(ShapeError, match="image has the wrong dtype or shape"):
            to_grey(wrong, mode)


def lens(model: LensModel, numbers: np.ndarray) -> CameraIntrinsics:
    matrix = np.diag([*numbers[:2], 1.0])
    matrix[:2, 2] = numbers[2:4]
    return CameraIntrinsics(matrix, numbers[4:], 640, 480, model)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("pinhole", []),
        ("pinhole", [-0.3, 0.1, 1e-3, -2e-3]),
        ("pinhole", [-0.3, 0.1, 1e-3, -2e-3, 0.01, 0.02, 0.03, 1e-3]),
        ("fisheye", [0.02, -0.01, 2e-3, 1e-3]),
    ],
)
def test_projection_has_inverse_and_derivatives(model, coefficients):
    xyz, step = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (20, 3)), 1e-6
    numbers = np.array([500.0, 501, 320, 240, *coefficients])
    camera = lens(model, numbers)
    rays_back = rays_of(camera, project_raw(camera, xyz))
    np.testing.assert_allclose(rays_back, xyz / xyz[:, 2:], atol=1e-9)
    assert np.isnan(project_raw(camera, np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0]]))).all()

    def slope(project: Callable[[float], np.ndarray]) -> np.ndarray:
        return (project(step) - project(-step)) / (2 * step)

    points = [slope(lambda s, a=axis: project_raw(camera, xyz + s * a)) for axis in np.eye(3)]
    lenses = [
        slope(lambda s, a=axis: project_raw(lens(model, numbers + s * a), xyz))
        for axis in np.eye(len(numbers))
    ]
    _, by_point, by_lens = project_with_jacobian(camera, xyz)
    # Central differences of pixels of size 1e3 in double precision: 1e3 * 1e-16 / 1e-6.
    np.testing.assert_allclose(by_point, np.stack(points, axis=-1), atol=1e-6)
    np.testing.assert_allclose(by_lens, np.stack(lenses, axis=-1), atol=1e-6)


CAMERA = RectifiedCamera(300.0, 199.5, 119.5, 199.5, 0.3, 400, 240)


def wall_pair(disparity_px: float = 12.0, row_px: float = 0.0, seed: int = 0) -> RectifiedPair:
    """A textured wall at one disparity; the right image lies ``row_px`` too low."""
    rng = np.random.default_rng(seed)
    wall = sum(
        cv2.GaussianBlur(rng.normal(size=(320, 520)), (0, 0), size) * size for size in (1.5, 4.0)
    )
    wall = np.clip(128 + 60 * wall, 0, 255).astype(np.float32)

    def crop(du: float, dv: float) -> np.ndarray:
        v, u = np.mgrid[0:240, 0:400].astype(np.float32)
        moved = cv2.remap(wall, u + np.float32(60 + du), v + np.float32(40 + dv), cv2.INTER_CUBIC)
        return np.clip(np.rint(moved + rng.normal(0, 1, moved.shape)), 0, 255).astype(np.uint8)

    return RectifiedPair(crop(0, 0), crop(disparity_px, -row_px), CAMERA)


def test_a_good_pair_has_rows_that_correspond_whatever_wrong_matches_say():
    pair = wall_pair()
    found = features.inspect_pair(pair)
    assert found.features > 100
    # A tenth of a pixel: cubic interpolation and one grey level of noise.
    assert abs(found.epipolar_error_px) < 0.1
    assert found.negative_ratio < 0.02
    assert features.check_inspection(found) == ()
    # Middlebury's doffs: a far point may have a negative disparity in a good pair.
    crossed = wall_pair(disparity_px=-12.0)
    crossed = replace(crossed, camera=replace(CAMERA, cx_right_px=CAMERA.cx_px + 30.0))
    assert features.inspect_pair(crossed).negative_ratio < 0.02
    rng = np.random.default_rng(3)
    left = rng.uniform(0, 400, (300, 2)).astype(np.float32)
    right = left + np.float32([-10.0, 2.0]) + rng.normal(0, 0.2, left.shape).astype(np.float32)
    right[:120] = rng.uniform(0, 400, (120, 2))
    found = features.inspect_features(features.PairFeatures(left, right))
    assert found.epipolar_error_px == pytest.approx(2.0, abs=0.1)
    assert found.features == pytest.approx(180, abs=8)


@pytest.mark.parametrize("row_px", [-5.0, -1.7, 1.7, 5.0, 20.0])
def test_rows_that_are_off_are_measured_and_said_whatever_the_exposure(row_px):
    pair = wall_pair(row_px=row_px)
    darker = replace(pair, right=(pair.right // 2).astype(np.uint8))
    assert features.inspect_pair(darker).epipolar_error_px == pytest.approx(row_px, abs=0.3)
    found = features.inspect_pair(pair)
    assert found.epipolar_error_px == pytest.approx(row_px, abs=0.2)
    (line,) = features.check_inspection(found)
    assert "left and right rows are not aligned" in line
    assert "recon audit --repair" in line
    assert f"{abs(row_px):.0f} px too {'low' if row_px > 0 else 'high'}" in line


@pytest.mark.parametrize("row_px", [0.0, 5.0])
def test_swapped_cameras_are_an_error_that_says_so(row_px):
    pair = wall_pair(row_px=row_px)
    found = features.inspect_pair(replace(pair, left=pair.right, right=pair.left))
    assert found.negative_ratio > 0.98
    with pytest.raises(CalibrationError, match="frame 7: left and right images are swapped"):
        features.check_inspection(found, where="frame 7")


def test_blank_images_other_scenes_and_one_at_infinity_give_no_answer():
    blank = np.full((240, 400), 255, np.uint8)
    found = features.inspect_pair(RectifiedPair(blank, blank, CAMERA))
    assert found.features == 0
    assert np.isnan(found.epipolar_error_px)
    far = features.inspect_pair(wall_pair(disparity_px=0.3))
    assert np.isnan(far.negative_ratio)
    strangers = features.inspect_pair(replace(wall_pair(seed=1), right=wall_pair(seed=2).right))
    assert [features.check_inspection(each) for each in (found, far, strangers)] == [(), (), ()]
