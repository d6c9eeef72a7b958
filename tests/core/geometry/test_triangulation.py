from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.geometry.projection import (
    depth_from_disparity,
    depth_sigma,
    disparity_from_depth,
    project,
    unproject,
)
from recon.core.values import RectifiedCamera

NAN = float("nan")
CAMERAS = st.builds(
    RectifiedCamera,
    focal_px=st.floats(100, 4000),
    cx_px=st.floats(0, 1000),
    cy_px=st.floats(0, 1000),
    cx_right_px=st.floats(0, 1000),
    baseline_m=st.floats(0.01, 2),
    width_px=st.just(1000),
    height_px=st.just(1000),
)
CAMERA = RectifiedCamera(721.5, 609.6, 172.9, 609.6, 0.537, 1242, 375)


@given(camera=CAMERAS, depth_m=st.floats(0.5, 200))
def test_depth_from_disparity_is_the_inverse_of_disparity_from_depth(
    camera: RectifiedCamera, depth_m: float
) -> None:
    fb = camera.focal_px * camera.baseline_m
    disparity = fb / depth_m - camera.doffs_px
    found = disparity_from_depth(np.array([depth_m]), camera)
    assert found[0] == pytest.approx(disparity, rel=1e-6, abs=1e-4)
    # In float64: float32 of a disparity beside a large doffs loses digits of the depth.
    back = depth_from_disparity(np.array([disparity]), camera)
    assert back.dtype == np.float32
    assert back[0] == pytest.approx(depth_m, rel=1e-5)


def test_a_published_pair_of_numbers_gives_the_published_depth() -> None:
    # Middlebury's own formula Z = baseline·f/(d + doffs), with the numbers of Motorcycle at Q.
    camera = RectifiedCamera(999.421, 294.182, 252.932, 326.96, 0.193001, 741, 497)
    depth = depth_from_disparity(np.array([50.0]), camera)
    assert depth[0] == pytest.approx(193.001e-3 * 999.421 / (50 + 32.778), rel=1e-6)


@pytest.mark.parametrize("doffs_px", [0.0, 20.0, -20.0])
def test_what_is_unknown_or_not_in_front_has_no_depth(doffs_px: float) -> None:
    camera = replace(CAMERA, cx_right_px=CAMERA.cx_px + doffs_px)
    disparity = np.array([NAN, -doffs_px, -doffs_px - 5, np.inf * -1, -doffs_px + 5])
    depth = depth_from_disparity(disparity, camera)
    assert np.isnan(depth).tolist() == [True, True, True, True, False]
    unknown = disparity_from_depth(np.array([NAN, 0.0, -1.0, 2.0]), camera)
    assert np.isnan(unknown).tolist() == [True, True, True, False]


def test_nothing_warns_on_unknown_values() -> None:
    with np.errstate(all="raise"):
        depth_from_disparity(np.array([NAN, 0.0, 1.0]), CAMERA)
        disparity_from_depth(np.array([NAN, 0.0, 1.0]), CAMERA)


@pytest.mark.parametrize("depth_m", [3.0, 10.0, 30.0])
@pytest.mark.parametrize("sigma_px", [0.1, 0.3])
def test_sigma_is_what_noise_on_the_disparity_does_to_the_depth(
    depth_m: float, sigma_px: float
) -> None:
    rng = np.random.default_rng(0)
    true = disparity_from_depth(np.array([depth_m]), CAMERA).astype(np.float64)
    measured = depth_from_disparity(true + rng.normal(0, sigma_px, 200_000), CAMERA)
    predicted = depth_sigma(np.array([depth_m]), sigma_px, CAMERA)[0]
    # 200 000 draws tell a deviation to 0.16 %; the second order of 1/d adds at most
    # (sigma_d / d)² ≈ 0.05 %.
    assert 0.99 < measured.std() / predicted < 1.01


def test_sigma_grows_with_the_square_of_the_depth() -> None:
    near, far = depth_sigma(np.array([5.0, 10.0]), 0.25, CAMERA)
    assert far / near == pytest.approx(4)
    assert np.isnan(depth_sigma(np.array([NAN]), 0.25, CAMERA)).all()


@given(camera=CAMERAS, seed=st.integers(0, 1000))
def test_a_pixel_with_depth_becomes_a_point_and_comes_back(
    camera: RectifiedCamera, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    u, v, depth = rng.uniform(0, 1000, 30), rng.uniform(0, 1000, 30), rng.uniform(0.5, 100, 30)
    xyz = unproject(u, v, depth, camera)
    np.testing.assert_allclose(xyz[:, 2], depth)
    columns, rows, disparity = project(xyz, camera)
    np.testing.assert_allclose(columns, u, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows, v, rtol=0, atol=1e-9)
    # Where the right camera sees the point: x - b in its own axes.
    right = camera.focal_px * (xyz[:, 0] - camera.baseline_m) / depth + camera.cx_right_px
    np.testing.assert_allclose(u - disparity, right, rtol=0, atol=1e-9)


def test_unprojecting_keeps_the_dtype_of_the_depth() -> None:
    u = np.arange(3)
    for dtype in (np.float32, np.float64):
        assert unproject(u, u, np.ones(3, dtype), CAMERA).dtype == dtype


def test_the_principal_point_looks_straight_ahead_right_is_x_and_down_is_y() -> None:
    cx, cy = CAMERA.cx_px, CAMERA.cy_px
    xyz = unproject(np.array([cx, cx + 10, cx]), np.array([cy, cy, cy + 10]), np.ones(3), CAMERA)
    np.testing.assert_allclose(np.sign(xyz), [[0, 0, 1], [1, 0, 1], [0, 1, 1]])


def test_points_behind_the_camera_have_no_pixel() -> None:
    for values in project(np.array([[0.0, 0, -1], [0, 0, 0], [0, 0, 1]]), CAMERA):
        assert np.isnan(values).tolist() == [True, True, False]
