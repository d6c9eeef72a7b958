from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.errors import CalibrationError
from recon.formats.middlebury import read_middlebury_scene
from recon.geometry.se3 import exp_so3
from recon.rectification import (
    PairFeatures,
    UncalibratedSettings,
    epipolar_lines,
    map_pixels,
    match_exactly,
    rectify_uncalibrated,
    to_grey,
)

SIZE = (640, 480)
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def scene(
    baseline: tuple[float, float, float] = (-0.15, 0.01, 0.02),
    turn: tuple[float, float, float] = (0.03, -0.05, 0.04),
    sigma_px: float = 0.0,
    *,
    flat: bool = False,
    count: int = 500,
) -> PairFeatures:
    """Points before two pinholes that are turned against each other."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2, -1.5, 2), (2, 1.5, 8), (count, 3))
    if flat:
        xyz[:, 2] = 4 + 0.3 * xyz[:, 0]
    left = xyz @ K.T
    right = (xyz @ exp_so3(np.array(turn)).T + baseline) @ K.T
    both = [p[:, :2] / p[:, 2:] + rng.normal(0, sigma_px, (count, 2)) for p in (left, right)]
    seen = np.all([(p > 0).all(axis=1) & (p < SIZE).all(axis=1) for p in both], axis=0)
    return PairFeatures(*(p[seen].astype(np.float32) for p in both))


def corners_of(H: np.ndarray) -> np.ndarray:
    return map_pixels(H, np.array([[0.0, 0], [639, 0], [639, 479], [0, 479]]))


def test_exact_matches_come_onto_exact_rows() -> None:
    found = rectify_uncalibrated(scene(), SIZE)
    # float32 pixels.
    assert np.abs(found.rows_px).max() < 0.01
    assert len(found.features) == found.matches


def test_with_noise_rows_are_off_by_no_more_than_noise() -> None:
    found = rectify_uncalibrated(scene(sigma_px=0.3), SIZE)
    truth = scene()
    rows = (
        map_pixels(found.H_left, truth.left_uv)[:, 1]
        - map_pixels(found.H_right, truth.right_uv)[:, 1]
    )
    assert np.abs(rows).mean() < 0.1
    # Rows of both pictures are noisy: mean |N(0, 0.3 sqrt 2)|.
    assert found.held_out_px == pytest.approx(0.34, rel=0.3)


def test_wrong_matches_do_no_harm() -> None:
    good = scene(sigma_px=0.2)
    rng = np.random.default_rng(1)
    wrong = rng.permutation(len(good))[: len(good) // 4]
    right = good.right_uv.copy()
    right[wrong] = rng.uniform(0, SIZE, (len(wrong), 2))
    found = rectify_uncalibrated(PairFeatures(good.left_uv, right), SIZE)
    truth = scene()
    rows = (
        map_pixels(found.H_left, truth.left_uv)[:, 1]
        - map_pixels(found.H_right, truth.right_uv)[:, 1]
    )
    assert np.abs(rows).mean() < 0.15


def test_pictures_stay_upright_in_size_and_disparities_positive() -> None:
    found = rectify_uncalibrated(scene(), SIZE)
    for H in (found.H_left, found.H_right):
        upper_left, upper_right, lower_right, lower_left = corners_of(H)
        assert upper_left[0] < upper_right[0]
        assert upper_left[1] < lower_left[1]
        area = 0.5 * abs(
            np.linalg.det(np.stack([lower_right - upper_left, upper_right - lower_left]))
        )
        assert area == pytest.approx(640 * 480, rel=0.25)
    assert found.disparity_px[0] == pytest.approx(4.0, abs=0.5)
    assert found.disparity_px[1] > 20


def test_near_points_have_the_larger_disparity() -> None:
    """Cameras that are only shifted: disparity orders points as depth does, to a slant."""
    xyz = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 8), (400, 3))
    left, right = (q @ K.T for q in (xyz, xyz + np.array([-0.2, 0.02, 0.0])))
    features = PairFeatures(*((p[:, :2] / p[:, 2:]).astype(np.float32) for p in (left, right)))
    found = rectify_uncalibrated(features, SIZE)
    disparity = (
        map_pixels(found.H_left, features.left_uv)[:, 0]
        - map_pixels(found.H_right, features.right_uv)[:, 0]
    )
    assert np.corrcoef(disparity, 1 / xyz[:, 2])[0, 1] > 0.99


def test_epipolar_lines_pass_through_the_partners() -> None:
    features = scene()
    found = rectify_uncalibrated(features, SIZE)
    left, right = (uv[:5].astype(float) for uv in (features.left_uv, features.right_uv))
    in_left, in_right = epipolar_lines(found.fundamental, left, right, SIZE)
    for pixels, lines in ((left, in_left), (right, in_right)):
        for pixel, line in zip(pixels, lines, strict=True):
            inside = line[np.isfinite(line).all(axis=1)]
            a, b = inside[0], inside[-1]
            across = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
            assert abs((pixel - a) @ across) < 0.1


def test_a_flat_scene_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"scene is flat.*100 % of the matches"):
        rectify_uncalibrated(scene(flat=True, sigma_px=0.1), SIZE)


def test_a_camera_in_view_of_the_other_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"sees the other camera.*side by side"):
        rectify_uncalibrated(scene(baseline=(0.01, 0.0, -0.5), turn=(0, 0, 0)), SIZE)


def test_too_few_matches_are_refused() -> None:
    with pytest.raises(CalibrationError, match=r"too few features.*at least 40"):
        rectify_uncalibrated(scene(count=30), SIZE)


def test_matches_without_any_geometry_are_refused() -> None:
    rng = np.random.default_rng(2)
    left, right = rng.uniform(0, SIZE, (2, 300, 2)).astype(np.float32)
    settings = UncalibratedSettings(min_features=60)
    with pytest.raises(CalibrationError):
        rectify_uncalibrated(PairFeatures(left, right), SIZE, settings)


def test_exact_features_know_places_to_a_third_of_a_pixel_under_a_homography() -> None:
    rng = np.random.default_rng(5)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (240, 320), dtype=np.uint8), (0, 0), 2.0)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    H = np.array([[1.05, 0.08, -9], [-0.05, 0.97, 6], [1e-4, -5e-5, 1]])
    warped = cv2.warpPerspective(picture, H, (320, 240), flags=cv2.INTER_CUBIC)
    found = match_exactly(picture, warped)
    apart = np.linalg.norm(map_pixels(H, found.left_uv) - found.right_uv, axis=1)
    assert len(found) > 100
    assert np.median(apart) < 0.33


def test_blank_pictures_have_no_features() -> None:
    blank = np.full((100, 100), 90, np.uint8)
    assert len(match_exactly(blank, blank)) == 0


@pytest.mark.real
@pytest.mark.parametrize("name", ["Jadeplant", "Motorcycle", "Pipes"])
def test_warped_middlebury_pairs_come_back_onto_rows_by_their_truth(
    recon_data: Path, name: str
) -> None:
    found = read_middlebury_scene(recon_data / "middlebury" / "MiddEval3" / "trainingQ" / name)
    left, right = to_grey(found.pair.left), to_grey(found.pair.right)
    height, width = left.shape
    border = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    rng = np.random.default_rng(3)
    shaken = [border + rng.uniform(-0.06, 0.06, (4, 2)) * width for _ in range(2)]
    A, B = (cv2.getPerspectiveTransform(border, s.astype(np.float32)) for s in shaken)
    warped = [cv2.warpPerspective(p, H, (width, height)) for p, H in ((left, A), (right, B))]
    result = rectify_uncalibrated(match_exactly(*warped), (width, height))
    assert found.truth is not None
    disparity = found.truth.values
    v, u = np.nonzero(np.isfinite(disparity))
    placed_left = map_pixels(result.H_left @ A, np.stack([u, v], axis=1))
    partner = np.stack([u - disparity[v, u], v], axis=1)
    rows = placed_left[:, 1] - map_pixels(result.H_right @ B, partner)[:, 1]
    assert np.abs(rows).mean() <= 0.7
