"""Features of the rendered street, found again where they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.core.geometry.projection import project, unproject
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.odometry.features import (
    find_again,
    find_corners,
    follow,
    measure_disparity,
    surface_slopes,
    warp_of,
)
from recon.odometry.protocol import OdometryFrame

See = Callable[..., OdometryFrame]
TURN = exp_so3(np.array([0.004, 0.01, 0.02]))


def features(
    frame: OdometryFrame, T_now_then: np.ndarray, camera: RectifiedCamera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners with one surface around them, their places in space, and where they are next."""
    uv = find_corners(frame.pair.left, np.zeros((0, 2), np.float32)).astype(np.float64)
    column, row = uv.astype(int).T
    depth = camera.focal_px * camera.baseline_m / frame.disparity.values[row, column]
    xyz = unproject(uv[:, 0], uv[:, 1], depth.astype(np.float64), camera)
    there = np.stack(project(apply(T_now_then, xyz), camera)[:2], axis=1)
    margin = 14  # a patch, and how much it grows
    inside = (there > margin).all(axis=1) & (uv > 20).all(axis=1)
    inside &= (there < [camera.width_px - margin, camera.height_px - margin]).all(axis=1)
    inside &= depth < 20.0
    return uv[inside], xyz[inside], there[inside]


def test_slopes_of_the_road_are_those_of_its_plane(see: See, camera: RectifiedCamera) -> None:
    frame = see(np.eye(4))
    uv = np.array([[150.0, 130.0], [200.0, 140.0], [250.0, 120.0]])
    # A plane 1.6 m below the camera: d = f·b/Z and v - cy = f·1.6/Z, so d = (v - cy)·b/1.6.
    np.testing.assert_allclose(
        surface_slopes(frame.disparity, uv), np.tile([0.0, 0.5 / 1.6], (3, 1)), atol=2e-3
    )


def test_the_warp_is_the_derivative_of_the_motion(camera: RectifiedCamera) -> None:
    T = make_transform(TURN, np.array([0.1, -0.05, -1.5]))
    uv, slope = np.array([[150.0, 130.0]]), np.array([[0.02, 0.3]])

    def seen(offset: np.ndarray) -> np.ndarray:
        d = 20.0 + offset @ slope[0]
        depth = np.array([camera.focal_px * camera.baseline_m / d])
        xyz = unproject(*(uv + offset).T, depth, camera)
        return np.concatenate(project(apply(T, xyz), camera)[:2])

    h = 1e-4
    numeric = [(seen(h * axis) - seen(-h * axis)) / (2 * h) for axis in np.eye(2)]
    depth = np.array([camera.focal_px * camera.baseline_m / 20.0])
    found = warp_of(uv, unproject(*uv.T, depth, camera), slope, T, camera)[0]
    np.testing.assert_allclose(found, np.stack(numeric, axis=1), atol=1e-6)


@pytest.mark.parametrize(("step_m", "off_px"), [(0.5, 0.1), (2.0, 0.2)])
def test_features_are_found_however_long_the_step(
    step_m: float, off_px: float, see: See, camera: RectifiedCamera
) -> None:
    T_then_now = make_transform(TURN, np.array([0.05, 0.0, step_m]))
    then, now = see(np.eye(4)), see(T_then_now)
    uv, xyz, there = features(then, invert(T_then_now), camera)
    warp = warp_of(uv, xyz, surface_slopes(then.disparity, uv), invert(T_then_now), camera)
    guess = there + np.random.default_rng(3).uniform(-1, 1, there.shape)
    found = find_again(then.pair.left, now.pair.left, uv, warp, guess)
    off = np.linalg.norm(found - there, axis=1)
    # At an edge between two planes part of a patch moves differently, and may not be alike.
    assert np.isfinite(off).mean() > 0.8
    assert np.nanmedian(off) < off_px


def test_near_features_are_found_that_tracking_loses(see: See, camera: RectifiedCamera) -> None:
    """Patches a third larger after a step: tracking, which looks for equal ones, is a pixel off."""
    T_then_now = make_transform(TURN, np.array([0.05, 0.0, 2.0]))
    then, now = see(np.eye(4)), see(T_then_now)
    uv, xyz, there = features(then, invert(T_then_now), camera)
    near = xyz[:, 2] < 12.0
    uv, xyz, there = uv[near], xyz[near], there[near]
    warp = warp_of(uv, xyz, surface_slopes(then.disparity, uv), invert(T_then_now), camera)
    found = find_again(then.pair.left, now.pair.left, uv, warp, there)
    followed, ok = follow(
        then.pair.left, now.pair.left, uv.astype(np.float32), there.astype(np.float32)
    )
    right = [
        where & (np.linalg.norm(at - there, axis=1) < 0.5)
        for at, where in ((followed, ok), (found, np.isfinite(found[:, 0])))
    ]
    assert right[0].mean() < 0.2
    assert right[1].mean() > 0.7


def test_a_darker_image_changes_no_place(see: See, camera: RectifiedCamera) -> None:
    frame = see(np.eye(4))
    uv, _, _ = features(frame, np.eye(4), camera)
    darker = np.rint(0.6 * frame.pair.left + 20).astype(np.uint8)
    warp = np.tile(np.eye(2), (len(uv), 1, 1))
    found = find_again(frame.pair.left, darker, uv, warp, uv + 0.7)
    assert np.nanmax(np.abs(found - uv)) < 0.05
    assert np.isfinite(found).mean() > 0.9


def test_disparities_are_measured_near_rough_ones(see_both: See) -> None:
    frame = see_both(np.eye(4))
    uv = find_corners(frame.pair.left, np.zeros((0, 2), np.float32)).astype(np.float64)
    uv = uv[uv[:, 0] > 80]  # seen in the right image, too
    column, row = uv.astype(int).T
    true = frame.disparity.values[row, column].astype(np.float64)
    off = np.random.default_rng(0).uniform(-1.0, 1.0, len(uv))

    found = measure_disparity(frame.pair, uv, true + off, surface_slopes(frame.disparity, uv))

    near = np.isfinite(found)
    assert near.mean() > 0.6
    assert np.median(np.abs(found - true)[near]) < 0.05
    flat = np.zeros((len(uv), 2))
    assert np.isnan(measure_disparity(frame.pair, uv, true + 30.0, flat)).mean() > 0.8
    assert np.isnan(measure_disparity(frame.pair, uv, np.full(len(uv), np.nan), flat)).all()
