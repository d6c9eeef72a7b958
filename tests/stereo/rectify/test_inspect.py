from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.errors import CalibrationError
from recon.core.values import RectifiedCamera, RectifiedPair
from recon.stereo.rectify.features import (
    PairFeatures,
    check_inspection,
    inspect_features,
    inspect_pair,
)

CAMERA = RectifiedCamera(
    focal_px=300.0,
    cx_px=199.5,
    cy_px=119.5,
    cx_right_px=199.5,
    baseline_m=0.3,
    width_px=400,
    height_px=240,
)


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


def swapped(pair: RectifiedPair) -> RectifiedPair:
    return replace(pair, left=pair.right, right=pair.left)


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


def test_swapped_eyes_are_an_error_that_says_so() -> None:
    found = inspect_pair(swapped(make_pair()))
    assert found.negative_share > 0.98
    with pytest.raises(CalibrationError, match="frame 7: left and right images are swapped"):
        check_inspection(found, where="frame 7")


def test_eyes_that_are_swapped_and_misaligned_are_still_swapped() -> None:
    found = inspect_pair(swapped(make_pair(row_px=5.0)))
    with pytest.raises(CalibrationError, match="swapped"):
        check_inspection(found)


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
