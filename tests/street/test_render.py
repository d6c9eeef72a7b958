"""Images and ground truth agree with each other and with analytic geometry."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.geometry import se3
from recon.core.geometry.projection import project, unproject
from recon.street.render import StreetCamera
from recon.street.street import StreetWorld, build_street


@pytest.fixture(scope="module")
def frame(street: StreetCamera):
    return street.render(1)


def _points(depth_m: np.ndarray, camera) -> np.ndarray:
    """float64 (H·W, 3), camera axes; NaN = sky."""
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    return unproject(u.ravel(), v.ravel(), depth_m.ravel().astype(np.float64), camera)


def test_images_are_colour_and_well_exposed(frame):
    for image in (frame.pair.left, frame.pair.right):
        assert image.shape == (120, 320, 3)
        assert 70 < image.mean() < 180
        assert image.std() > 35
        assert (image == 255).mean() < 0.1


def test_depth_of_the_box_world_is_that_on_paper(box_world: StreetWorld):
    depth = StreetCamera(box_world).depth(0)
    v, u = np.mgrid[0:100, 0:200]
    # Camera 1.5 m above the road, f = 100 px, principal point (99.5, 49.5).
    road = np.where(v > 49.5, 100.0 * 1.5 / np.where(v > 49.5, v - 49.5, 1), np.inf)
    expected = np.minimum(road, 20.0)
    x, y = (u - 99.5) * 8 / 100, (v - 49.5) * 8 / 100
    front = (np.abs(x) < 1.0) & (y > -0.3) & (y < 1.49)
    top = (v == 49) | (v == 48)
    expected[front] = 8.0
    certain = ~top & (np.abs(np.abs(x) - 1.0) > 0.2)
    # Corners are stored in single precision: 1e-6 m at these distances.
    np.testing.assert_allclose(depth[certain], expected[certain], rtol=3e-6)


def test_the_road_lies_on_the_ground_plane(frame, street):
    xyz = _points(frame.depth_m, street.world.camera)
    height = xyz @ frame.ground_plane[:3] + frame.ground_plane[3]
    below = height[np.isfinite(height)].reshape(-1)
    on_road = np.abs(below) < 1e-4
    on_pavement = np.abs(below - 0.12) < 1e-4
    assert on_road.mean() > 0.15
    assert on_pavement.mean() > 0.01
    # Nothing is below the road; float32 depths of 30 m are good to 2e-6 m.
    assert below.min() > -1e-4


def test_disparity_times_depth_is_focal_length_times_baseline_but_for_the_sky(frame, street):
    camera, sky = street.world.camera, np.isnan(frame.depth_m)
    product = (frame.truth.values * frame.depth_m)[~sky]
    assert np.allclose(product, camera.focal_px * camera.baseline_m)
    assert 0.02 < sky.mean() < 0.5
    assert np.array_equal(sky, np.isnan(frame.truth.values))
    assert not frame.truth.nonocc[sky].any()
    # It is blue or white but where an edge blends with a roof, and above the road.
    red, _, blue = frame.pair.left[sky].astype(int).T
    assert (blue >= red).mean() > 0.95
    assert not sky[80:].any()


def test_the_right_view_warped_by_the_truth_is_the_left_view(frame):
    d, keep = frame.truth.values, frame.truth.nonocc.copy()
    v, u = np.mgrid[0:120, 0:320].astype(np.float32)
    x = (u - np.nan_to_num(d)).astype(np.float32)
    fetched = cv2.remap(frame.pair.right.astype(np.float32), x, v, cv2.INTER_LANCZOS4)
    error = np.abs(fetched - frame.pair.left).mean(axis=2)[keep & (x > 3) & (x < 316)]
    # Most surfaces are smooth at this size; the tail are edges that both views blend differently.
    assert np.median(error) < 1.5
    assert np.percentile(error, 90) < 10.0
    # One pixel off is clearly worse: the truth is where the images agree.
    shifted = cv2.remap(frame.pair.right.astype(np.float32), x + 1, v, cv2.INTER_LANCZOS4)
    worse = np.abs(shifted - frame.pair.left).mean(axis=2)[keep & (x > 3) & (x < 316)]
    assert worse.mean() > 2.0 * error.mean()


def test_nonocc_at_the_edge_of_a_box_is_that_on_paper(box_world: StreetWorld):
    truth = StreetCamera(box_world).disparity_truth(0)
    # Row 48, 0.12 m above the cameras' height, looks over the road at box (8 m) and wall (20 m).
    row, d = truth.nonocc[48], truth.values[48]
    box = np.flatnonzero(d > 6.0)
    assert np.allclose(d[box], 100 * 0.5 / 8.0)
    assert np.allclose(np.delete(d, box), 100 * 0.5 / 20.0)
    # The box's left edge is at x = -1 m: column 99.5 - 12.5 = 87 in the left view, 80.75 in the
    # right one, where the wall appears 2.5 px further right than in the left view: 83.25.
    hidden = np.flatnonzero(~row[box[0] - 10 : box[0]]) + box[0] - 10
    assert box[0] == 87
    assert hidden.tolist() == [84, 85, 86]
    # Columns whose point lies left of the right image (beyond half a pixel): u < 2.
    assert row[:4].tolist() == [False, False, True, True]
    assert row[box].all()


def test_points_of_one_frame_are_found_by_the_next(street):
    camera, here, there = street.world.camera, 0, 2
    poses = street.world.trajectory.T_world_camera
    xyz = _points(street.depth(here), camera)
    moved = se3.apply(se3.invert(poses[there]) @ poses[here], xyz[np.isfinite(xyz[:, 2])])
    u, v, _ = project(moved, camera)
    inside = (u > 0) & (u < camera.width_px - 1) & (v > 0) & (v < camera.height_px - 1)
    view = street.views(there)[0]
    pixels = np.stack([u[inside], v[inside]], axis=1)
    found = street.stage.depth(view.origin, view.directions(pixels))
    # A ray to a point ends there or before it; poses and depths are good to float32.
    assert (found <= moved[inside, 2] * (1 + 1e-4) + 1e-3).mean() > 0.999
    same = np.isclose(found, moved[inside, 2], rtol=1e-5, atol=1e-4)
    assert same.mean() > 0.85


def test_images_are_bit_identical_whatever_the_number_of_threads(street, small_settings):
    again = StreetCamera(build_street(small_settings.model_copy(update={"threads": 1})))
    one, other = street.render(2), again.render(2)
    assert np.array_equal(one.pair.left, other.pair.left)
    assert np.array_equal(one.pair.right, other.pair.right)
    assert np.array_equal(one.truth.values, other.truth.values, equal_nan=True)
    assert np.array_equal(one.truth.nonocc, other.truth.nonocc)


def test_a_longer_drive_goes_down_the_same_street(street, small_settings):
    longer = StreetCamera(build_street(small_settings.model_copy(update={"frames": 12})))
    here, there = street.depth(3), longer.depth(3)
    near = np.nan_to_num(here, nan=np.inf) < 60.0
    assert near.mean() > 0.5
    # On the edge between two triangles either may be hit: the same to rounding.
    np.testing.assert_allclose(here[near], there[near], rtol=1e-6)


def test_noise_and_gain_change_images_but_not_truth(street, small_settings):
    update = {"noise_dn": 3.0, "right_gain": 0.8, "right_offset_dn": 5.0}
    noisy = StreetCamera(
        dataclasses.replace(street.world, settings=small_settings.model_copy(update=update))
    )
    clean, frame = street.render(0), noisy.render(0)
    mid = (clean.pair.left > 30) & (clean.pair.left < 225)
    difference = frame.pair.left.astype(float) - clean.pair.left
    assert 2.8 < difference[mid].std() < 3.2
    bright = (clean.pair.right > 60) & (clean.pair.right < 225)
    expected = 0.8 * clean.pair.right[bright].astype(float) + 5.0
    assert np.abs((frame.pair.right[bright] - expected).mean()) < 0.2
    assert np.array_equal(frame.truth.values, clean.truth.values, equal_nan=True)
    assert np.array_equal(noisy.pair(0).left, frame.pair.left)
    other = noisy.pair(1).left.astype(float) - street.pair(1).left
    assert abs(np.corrcoef(difference[mid], other[mid])[0, 1]) < 0.05


def test_a_frame_that_is_not_there_is_refused(street):
    for index in (-1, 4):
        with pytest.raises(SettingsError, match="no such frame"):
            street.depth(index)
