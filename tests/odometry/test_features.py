"""Features of an image, and where they are in the next one."""

import numpy as np
import pytest

from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values.camera import project, unproject
from recon.odometry import features
from recon.odometry.protocol import OdometryFrame

NONE = np.zeros((0, 2), np.float32)


def per_cell(uv: np.ndarray) -> np.ndarray:
    cells = (uv[:, 1] // features._CELL_PX) * 1000 + uv[:, 0] // features._CELL_PX
    return np.unique(cells, return_counts=True)[1]


def test_no_cell_holds_more_than_its_share_also_with_features_already_followed(see):
    grey = see(np.eye(4)).pair.left
    first = features.find_corners(grey, NONE)
    assert len(first) > 50
    assert per_cell(first).max() <= features._PER_CELL
    more = features.find_corners(grey, first)
    assert per_cell(np.concatenate([first, more])).max() <= features._PER_CELL
    distance = np.linalg.norm(first[:, None] - more[None], axis=2)
    assert distance.size == 0 or distance.min() >= features._DISTANCE_PX


def test_corners_of_a_square_are_found_and_of_a_crowd_the_first_stay():
    grey = np.full((100, 100), 50, np.uint8)
    grey[30:60, 30:60] = 200
    uv = features.find_corners(grey, NONE, cell_px=20)
    square = np.array([[29.5, 29.5], [59.5, 29.5], [29.5, 59.5], [59.5, 59.5]])
    distance = np.linalg.norm(uv[:, None] - square[None], axis=2)
    assert len(uv) >= 4
    assert distance.min(axis=0).max() < 3.0
    assert distance.min(axis=1).max() < 3.0
    for nothing in (np.full((80, 90), 128, np.uint8), np.zeros((5, 5), np.uint8)):
        assert features.find_corners(nothing, NONE).shape == (0, 2)
    gathered = np.array([[50.0, 50.0], [np.nan, np.nan], [200.0, 10.0]] + 4 * [[45.0, 60.0]])
    expected = [False, False, False, False, False, True, True]
    assert features.in_crowd(gathered, (100, 300)).tolist() == expected
    assert features.in_crowd(np.zeros((0, 2)), (100, 300)).shape == (0,)


def test_what_leaves_the_image_is_not_followed(see):
    grey = see(np.eye(4)).pair.left
    uv = features.find_corners(grey, NONE)
    shift = np.array([30, 12])
    moved = np.roll(grey, shift[::-1], axis=(0, 1))
    there, found = features.follow(grey, moved, uv, (uv + shift).astype(np.float32))
    height, width = grey.shape
    inside = (uv + shift < [width - 15, height - 15]).all(axis=1)
    assert found[inside].mean() > 0.9
    assert np.median(np.abs(there - uv - shift)[found & inside]) < 0.01
    assert not found[((there > [width - 1, height - 1]) | (there < 0)).any(axis=1)].any()


TURN = exp_so3(np.array([0.004, 0.01, 0.02]))


def corners(frame: OdometryFrame) -> np.ndarray:
    return features.find_corners(frame.pair.left, NONE).astype(np.float64)


def seen_features(frame, T_now_then, camera):
    """Corners with one surface around them, their places in space, and where they are next."""
    uv = corners(frame)
    column, row = uv.astype(int).T
    depth = camera.focal_px * camera.baseline_m / frame.disparity.values[row, column]
    xyz = unproject(uv[:, 0], uv[:, 1], depth.astype(np.float64), camera)
    there = np.stack(project(apply(T_now_then, xyz), camera)[:2], axis=1)
    margin = 14  # a patch, and how much it grows
    inside = (there > margin).all(axis=1) & (uv > 20).all(axis=1)
    inside &= (there < [camera.width_px - margin, camera.height_px - margin]).all(axis=1)
    inside &= depth < 20.0
    return uv[inside], xyz[inside], there[inside]


def test_slopes_are_those_of_the_plane_and_the_warp_is_the_derivative_of_the_motion(see, camera):
    frame = see(np.eye(4))
    uv = np.array([[150.0, 130.0], [200.0, 140.0], [250.0, 120.0]])
    # A plane 1.6 m below the camera: d = f·b/Z and v - cy = f·1.6/Z, so d = (v - cy)·b/1.6.
    np.testing.assert_allclose(
        features.surface_slopes(frame.disparity, uv), np.tile([0.0, 0.5 / 1.6], (3, 1)), atol=2e-3
    )
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
    found = features.warp_of(uv, unproject(*uv.T, depth, camera), slope, T, camera)[0]
    np.testing.assert_allclose(found, np.stack(numeric, axis=1), atol=1e-6)


@pytest.mark.parametrize(("step_m", "off_px"), [(0.5, 0.1), (2.0, 0.2)])
def test_features_are_found_however_long_the_step(step_m, off_px, see, camera):
    T_then_now = make_transform(TURN, np.array([0.05, 0.0, step_m]))
    then, now = see(np.eye(4)), see(T_then_now)
    uv, xyz, there = seen_features(then, invert(T_then_now), camera)
    warp = features.warp_of(
        uv, xyz, features.surface_slopes(then.disparity, uv), invert(T_then_now), camera
    )
    images = then.pair.left, now.pair.left
    guess = there + np.random.default_rng(3).uniform(-1, 1, there.shape)
    found = features.find_again(*images, uv, warp, guess)
    off = np.linalg.norm(found - there, axis=1)
    # At an edge between two planes part of a patch moves differently, and may not be alike.
    assert np.isfinite(off).mean() > 0.8
    assert np.nanmedian(off) < off_px
    if step_m > 1:  # near patches are a third larger: tracking, which looks for equal ones, fails
        near = xyz[:, 2] < 12.0
        followed, ok = features.follow(*images, uv.astype(np.float32), there.astype(np.float32))
        assert (ok & (np.linalg.norm(followed - there, axis=1) < 0.5))[near].mean() < 0.2
        assert (off < 0.5)[near].mean() > 0.7


def test_features_are_found_in_the_right_image_near_a_rough_disparity(see_both):
    frame = see_both(np.eye(4))
    uv = corners(frame)
    uv = uv[uv[:, 0] > 80]  # seen in the right image, too
    column, row = uv.astype(int).T
    true = frame.disparity.values[row, column].astype(np.float64)
    off = np.random.default_rng(0).uniform(-1.0, 1.0, len(uv))
    slopes = features.surface_slopes(frame.disparity, uv)
    there = features.find_in_right(frame.pair, uv, true + off, slopes)
    near = np.isfinite(there[:, 0])
    assert near.mean() > 0.6
    assert np.median(np.abs(uv[:, 0] - there[:, 0] - true)[near]) < 0.05
    assert np.median(np.abs(uv[:, 1] - there[:, 1])[near]) < 0.05
    for wrong in (true + 30.0, np.full(len(uv), np.nan)):
        found = features.find_in_right(frame.pair, uv, wrong, np.zeros((len(uv), 2)))
        assert np.isnan(found[:, 0]).mean() > 0.7
