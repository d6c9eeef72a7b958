"""Lens models have inverses and derivatives; matched features show what is no rectified pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.errors import CalibrationError
from recon.core.values import CameraIntrinsics, LensModel, RectifiedCamera, RectifiedPair
from recon.stereo.rectify.features import (
    PairFeatures,
    check_inspection,
    inspect_features,
    inspect_pair,
)
from recon.stereo.rectify.lens import project_raw, project_with_jacobian, rays_of

LENSES: list[tuple[LensModel, list[float]]] = [
    ("pinhole", []),
    ("pinhole", [-0.3, 0.1, 1e-3, -2e-3]),
    ("pinhole", [-0.3, 0.1, 1e-3, -2e-3, 0.01]),
    ("pinhole", [-0.3, 0.1, 1e-3, -2e-3, 0.01, 0.02, 0.03, 1e-3]),
    ("fisheye", [0.02, -0.01, 2e-3, 1e-3]),
]
XYZ = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (20, 3))
STEP = 1e-6


def lens(model: LensModel, numbers: np.ndarray) -> CameraIntrinsics:
    fx, fy, cx, cy = numbers[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return CameraIntrinsics(matrix, numbers[4:], 640, 480, model)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_projection_has_its_inverse_and_its_derivatives(
    model: LensModel, coefficients: list[float]
) -> None:
    numbers = np.array([500.0, 501, 320, 240, *coefficients])
    camera = lens(model, numbers)
    rays = rays_of(camera, project_raw(camera, XYZ))
    np.testing.assert_allclose(rays, XYZ / XYZ[:, 2:], atol=1e-9)
    assert np.isnan(project_raw(camera, np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0]]))).all()

    def slope(project: Callable[[float], np.ndarray]) -> np.ndarray:
        return (project(STEP) - project(-STEP)) / (2 * STEP)

    points = [slope(lambda s, a=axis: project_raw(camera, XYZ + s * a)) for axis in np.eye(3)]
    lenses = [
        slope(lambda s, a=axis: project_raw(lens(model, numbers + s * a), XYZ))
        for axis in np.eye(len(numbers))
    ]
    _, by_point, by_lens = project_with_jacobian(camera, XYZ)
    # Central differences of pixels of size 1e3 in double precision: 1e3 * 1e-16 / 1e-6.
    np.testing.assert_allclose(by_point, np.stack(points, axis=-1), atol=1e-6)
    np.testing.assert_allclose(by_lens, np.stack(lenses, axis=-1), atol=1e-6)


def test_rays_at_ninety_degrees_and_more_are_nan() -> None:
    camera = lens("fisheye", np.array([100.0, 100, 320, 240, 0, 0, 0, 0]))
    rays = rays_of(camera, np.array([[320 + 100 * 1.5, 240], [320 + 100 * 1.7, 240]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).any()


CAMERA = RectifiedCamera(300.0, 199.5, 119.5, 199.5, 0.3, 400, 240)


def make_pair(disparity_px: float = 12.0, row_px: float = 0.0, seed: int = 0) -> RectifiedPair:
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


def test_a_good_pair_has_rows_that_correspond_and_no_negative_disparity() -> None:
    found = inspect_pair(make_pair())
    assert found.features > 100
    # A tenth of a pixel: cubic interpolation and one grey level of noise.
    assert abs(found.row_error_px) < 0.1
    assert 0.0 <= found.row_spread_px < 0.3
    assert found.negative_share < 0.02
    assert check_inspection(found) == ()


@pytest.mark.parametrize("row_px", [-5.0, -1.7, 1.7, 5.0, 20.0])
def test_rows_that_are_off_are_measured_and_said(row_px: float) -> None:
    found = inspect_pair(make_pair(row_px=row_px))
    assert found.row_error_px == pytest.approx(row_px, abs=0.2)
    (line,) = check_inspection(found)
    assert "rows of left and right are not aligned" in line
    assert f"{abs(row_px):.0f} px too {'low' if row_px > 0 else 'high'}" in line


@pytest.mark.parametrize("row_px", [0.0, 5.0])
def test_swapped_eyes_are_an_error_that_says_so(row_px: float) -> None:
    pair = make_pair(row_px=row_px)
    found = inspect_pair(replace(pair, left=pair.right, right=pair.left))
    assert found.negative_share > 0.98
    with pytest.raises(CalibrationError, match="frame 7: left and right images are swapped"):
        check_inspection(found, where="frame 7")


def test_exposure_between_the_eyes_changes_nothing() -> None:
    pair = make_pair(row_px=2.0)
    darker = replace(pair, right=(pair.right // 2).astype(np.uint8))
    assert inspect_pair(darker).row_error_px == pytest.approx(2.0, abs=0.3)


def test_a_scene_at_infinity_does_not_tell_the_eyes_apart() -> None:
    found = inspect_pair(make_pair(disparity_px=0.3))
    assert np.isnan(found.negative_share)
    assert check_inspection(found) == ()


def test_offset_principal_points_do_not_look_like_swapped_eyes() -> None:
    """Middlebury's doffs: a far point may have a negative disparity in a good pair."""
    pair = make_pair(disparity_px=-12.0)
    crossed = replace(pair, camera=replace(CAMERA, cx_right_px=CAMERA.cx_px + 30.0))
    assert inspect_pair(crossed).negative_share < 0.02


@pytest.mark.parametrize("level", [0, 255])
def test_images_without_features_give_no_answer(level: int) -> None:
    blank = np.full((240, 400), level, np.uint8)
    found = inspect_pair(RectifiedPair(blank, blank, CAMERA))
    assert found.features == 0
    assert np.isnan(found.row_error_px)
    assert check_inspection(found) == ()


def test_images_of_different_scenes_give_no_answer() -> None:
    strangers = replace(make_pair(seed=1), right=make_pair(seed=2).right)
    assert check_inspection(inspect_pair(strangers)) == ()


def test_wrong_matches_do_not_move_the_row_error() -> None:
    rng = np.random.default_rng(3)
    left = rng.uniform(0, 400, (300, 2)).astype(np.float32)
    right = left + np.float32([-10.0, 2.0]) + rng.normal(0, 0.2, left.shape).astype(np.float32)
    right[:120] = rng.uniform(0, 400, (120, 2))
    found = inspect_features(PairFeatures(left, right))
    assert found.row_error_px == pytest.approx(2.0, abs=0.1)
    assert found.features == pytest.approx(180, abs=8)
