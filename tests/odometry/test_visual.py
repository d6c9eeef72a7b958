from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import Disparity, RectifiedPair
from recon.odometry.features import in_crowd
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualOdometry
from recon.stereo.match.sad import HalfSizeMatcher, SadSettings

See = Callable[..., OdometryFrame]


def follow(frames: list[OdometryFrame] | tuple[OdometryFrame, ...]) -> np.ndarray:
    odometry = VisualOdometry()
    return np.stack([odometry.register(frame).T_world_camera for frame in frames])


def yaw(angle_rad: float) -> np.ndarray:
    return make_transform(exp_so3(np.array([0.0, angle_rad, 0.0])), np.zeros(3))


def forward(distance_m: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([0.0, 0.0, distance_m]))


def test_a_camera_that_stands_still_stays(see: See) -> None:
    poses = follow([see(np.eye(4))] * 4)
    # Equal images: what is left is the optimiser's rounding.
    np.testing.assert_allclose(poses, np.tile(np.eye(4), (4, 1, 1)), atol=1e-4)


@pytest.mark.parametrize("step", [forward(0.5), yaw(0.02), forward(-0.3), forward(0.4) @ yaw(0.01)])
def test_a_motion_is_found(step: np.ndarray, see: See) -> None:
    truth = [np.linalg.matrix_power(step, n) for n in range(5)]
    off = invert(follow([see(T) for T in truth])[-1]) @ truth[-1]
    # 1 % of a 2 m path; a quarter of a pixel (1/260 rad) in four frames, as patches that grow
    # or turn while they are followed cost some hundredths of a pixel each time.
    assert np.linalg.norm(off[:3, 3]) < 0.02
    assert angle_rad(off) < 0.25 / 260


def test_features_stay_spread_over_the_image_where_a_drive_backwards_gathers_them(
    street: tuple[OdometryFrame, ...],
) -> None:
    odometry = VisualOdometry()
    for frame in reversed(street):
        odometry.register(frame)
    newest = odometry.window.uvd[-1, odometry.window.seen[-1], :2]
    assert len(newest) > 50
    assert not in_crowd(newest, street[0].pair.left.shape).any()


def test_the_first_frame_is_the_identity(see: See, street_poses: np.ndarray) -> None:
    np.testing.assert_array_equal(follow([see(street_poses[3])])[0], np.eye(4))


def test_motion_does_not_depend_on_where_the_drive_begins(
    street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    late = follow(street[4:8])
    whole = follow(street)[:8]
    relative = invert(whole[4]) @ whole[7]
    # Other frames were in the window; both are good to about 1 % of 1.5 m.
    assert np.linalg.norm(relative[:3, 3] - late[3][:3, 3]) < 0.03


def test_two_runs_are_equal_to_the_bit(street: tuple[OdometryFrame, ...]) -> None:
    np.testing.assert_array_equal(follow(street), follow(street))


def test_a_black_frame_extrapolates_says_so_and_is_recovered_from(
    see: See, blind: See, street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    odometry = VisualOdometry()
    results = [odometry.register(f) for f in (*street[:6], blind(index=6), *street[7:])]
    assert [result.health.ok for result in results] == [True] * 6 + [False] + [True] * 5
    assert "lost" in results[6].health.notes[0]
    last = results[-1].T_world_camera
    # The motion is constant, so the extrapolated step costs hardly more than a seen one.
    assert np.linalg.norm((invert(street_poses[-1]) @ last)[:3, 3]) < 0.1


def test_a_missing_disparity_map_does_not_lose_the_camera(
    blind: See, street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    empty = OdometryFrame(street[6].pair, blind().disparity)
    odometry = VisualOdometry()
    results = [odometry.register(f) for f in (*street[:6], empty, *street[7:])]
    assert all(result.health.ok for result in results)
    off = invert(street_poses[-1]) @ results[-1].T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 0.06


def test_a_blank_wall_gives_no_motion_and_no_exception(blind: See) -> None:
    odometry = VisualOdometry()
    results = [odometry.register(blind(128, n)) for n in range(3)]
    assert results[0].health.ok
    assert not results[1].health.ok
    np.testing.assert_allclose(results[2].T_world_camera, np.eye(4), atol=1e-12)


def test_an_object_that_moves_does_not_move_the_camera(see: See) -> None:
    """A third of the image shows the street from elsewhere, as on the side of a passing bus."""
    truth = [forward(0.4 * n) for n in range(5)]
    frames = []
    for n, T in enumerate(truth):
        street, bus = see(T, n), see(forward(-0.3 * n), n)
        frames.append(_pasted(street, bus))
    off = invert(follow(frames)[-1]) @ truth[-1]
    assert np.linalg.norm(off[:3, 3]) < 0.05


def _pasted(below: OdometryFrame, above: OdometryFrame) -> OdometryFrame:
    """The left third of one frame on another."""
    third = slice(0, below.pair.camera.width_px // 3)
    grey = below.pair.left.copy()
    grey[:, third] = above.pair.left[:, third]
    values = below.disparity.values.copy()
    values[:, third] = above.disparity.values[:, third]
    pair = RectifiedPair(grey, grey, below.pair.camera, index=below.pair.index)
    return OdometryFrame(pair, replace(below.disparity, values=values))


def test_frames_that_are_missing_are_bridged_by_what_looks_alike(
    street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    """A jump of 2.5 m that the times do not show: tracks are lost, the pose is not."""
    late = [replace(f, pair=replace(f.pair, timestamp_s=0.1 * n)) for n, f in enumerate(street)]
    jump = [*late[:5], *(late[n] for n in (9, 10, 11))]
    odometry = VisualOdometry()
    results = [odometry.register(frame) for frame in jump]
    assert all(result.health.ok for result in results)
    off = invert(street_poses[-1]) @ results[-1].T_world_camera
    # Some thirty features, placed to about a pixel; the last motion going on is 2 m off.
    assert np.linalg.norm(off[:3, 3]) < 0.2


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_a_jump_of_the_exposure_loses_no_frame(
    gain: float, street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    frames = [*street[:5], *(_exposed(frame, gain) for frame in street[5:])]
    odometry = VisualOdometry()
    results = [odometry.register(frame) for frame in frames]
    assert all(result.health.ok for result in results)
    off = invert(street_poses[-1]) @ results[-1].T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 0.06


def test_sight_that_comes_back_finds_the_last_seen_frame(
    blind: See, street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    frames = [*street[:5], *(blind(index=n) for n in (5, 6, 7)), *street[8:]]
    odometry = VisualOdometry()
    results = [odometry.register(frame) for frame in frames]
    assert [result.health.ok for result in results] == [True] * 5 + [False] * 3 + [True] * 4
    # Measured across the gap: 2 m in one step, by patches that grew meanwhile.
    off = invert(street_poses[-1]) @ results[-1].T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 0.1


def test_a_drive_that_begins_blind_begins_where_it_sees(
    blind: See, street: tuple[OdometryFrame, ...]
) -> None:
    odometry = VisualOdometry()
    results = [odometry.register(frame) for frame in (blind(), blind(), *street[:4])]
    np.testing.assert_allclose(results[2].T_world_camera, np.eye(4), atol=1e-12)
    assert [result.health.ok for result in results[:2]] == [True, False]
    assert results[-1].health.ok


def test_health_says_how_sure_the_motion_is(street: tuple[OdometryFrame, ...]) -> None:
    odometry = VisualOdometry()
    results = [odometry.register(frame) for frame in street]
    for result in results[1:]:
        assert 0.0 < result.health.sigma_m < 0.05
        assert 0.0 < result.health.sigma_deg < 0.5


def test_the_stated_error_of_a_motion_is_about_its_error(
    street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    odometry = VisualOdometry()
    results = [odometry.register(frame) for frame in street]
    path = np.stack([result.T_world_camera for result in results])
    steps, truth = (invert(T[:-1]) @ T[1:] for T in (path, street_poses))
    off_m = np.linalg.norm((steps - truth)[:, :3, 3], axis=1)
    stated_m = np.array([result.health.sigma_m for result in results[1:]])
    ratio = np.sqrt(np.square(off_m / stated_m).mean())
    # 1.06; eleven steps, of which neighbours share their features.
    assert 0.5 < ratio < 2.0


@pytest.mark.parametrize("error_px", [-0.3, 0.3])
def test_what_all_disparities_are_off_is_in_the_length_as_health_says(
    error_px: float, street: tuple[OdometryFrame, ...]
) -> None:
    right, wrong = VisualOdometry(), VisualOdometry()
    results = [right.register(frame) for frame in street]
    off = [wrong.register(_off(frame, error_px)) for frame in street]
    scale_px = np.mean([result.health.scale_px for result in results[1:]])
    assert _way_m(off) / _way_m(results) - 1.0 == pytest.approx(-error_px / scale_px, rel=0.1)


def _way_m(results: list[OdometryResult]) -> float:
    places = np.stack([result.T_world_camera[:3, 3] for result in results])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def _off(frame: OdometryFrame, error_px: float) -> OdometryFrame:
    return replace(frame, disparity=Disparity.from_values(frame.disparity.values + error_px))


def _exposed(frame: OdometryFrame, gain: float) -> OdometryFrame:
    grey = np.clip(np.rint(gain * frame.pair.left), 0, 255).astype(np.uint8)
    return replace(frame, pair=replace(frame.pair, left=grey, right=grey))


def test_rough_disparities_give_nearly_the_same_path(
    see_both: See, street_poses: np.ndarray
) -> None:
    matcher = HalfSizeMatcher(SadSettings(), threads=1)
    pairs = [see_both(T, index).pair for index, T in enumerate(street_poses)]

    found = follow([OdometryFrame(pair, matcher.match(pair), rough=True) for pair in pairs])

    truth = invert(street_poses[0]) @ street_poses
    length_m = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    assert np.linalg.norm(found[-1, :3, 3] - truth[-1, :3, 3]) < 0.02 * length_m
