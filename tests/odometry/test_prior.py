"""An external trajectory as motion prior: any rate, any world frame; its axes are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import RegistrationError, SettingsError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.odometry.prior import MotionPrior
from recon.odometry.prior_axes import find_axes, first_moving
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.registry import make_odometry
from recon.odometry.settings import OdometrySettings, PriorSettings
from tests.odometry.conftest import STEP, See, off_m, steps

ELSEWHERE = make_transform(exp_so3(np.array([0.3, -1.2, 0.4])), np.array([500.0, -20.0, 3.0]))
CAMERA_FROM_BODY = make_transform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3)
)


def path(poses: np.ndarray, interval_s: float = 0.1, start_s: float = 0.0) -> Trajectory:
    """The poses in another world, as a receiver would give them."""
    times_s = start_s + interval_s * np.arange(len(poses))
    return Trajectory(ELSEWHERE @ poses, times_s)


def register(frames: list[OdometryFrame], prior: Trajectory | None) -> list[OdometryResult]:
    odometry = make_odometry("visual", OdometrySettings(), prior)
    return [odometry.register(frame) for frame in frames]


def test_motions_do_not_depend_on_the_world_of_the_path() -> None:
    prior = MotionPrior(path(steps(5)), PriorSettings())
    # Positions of 500 m have 1e-13 of them as rounding.
    np.testing.assert_allclose(prior.motion(0.1, 0.2), STEP, atol=1e-9)


def test_between_poses_the_path_is_interpolated() -> None:
    coarse = MotionPrior(path(steps(9)[::4], interval_s=0.4), PriorSettings())
    found = coarse.motion(0.1, 0.2)
    # A chord of an arc of 0.04 rad and 2 m: 2 m · 0.04 / 8 to the side at most.
    np.testing.assert_allclose(found, STEP, atol=0.01)


def test_body_axes_are_turned_into_those_of_the_camera() -> None:
    body = np.stack([T @ CAMERA_FROM_BODY for T in steps(4)])
    prior = MotionPrior(path(body), PriorSettings(axes="body"))
    np.testing.assert_allclose(prior.motion(0.0, 0.1), STEP, atol=1e-9)


@pytest.mark.parametrize(("from_s", "to_s"), [(-0.1, 0.1), (0.3, 0.6), (0.2, 0.2), (0.2, 0.1)])
def test_outside_of_the_path_and_across_a_gap_nothing_is_reported(
    from_s: float, to_s: float
) -> None:
    assert MotionPrior(path(steps(5)), PriorSettings()).motion(from_s, to_s) is None
    gappy = MotionPrior(path(steps(3), interval_s=2.0), PriorSettings())
    assert gappy.motion(0.5, 0.6) is None


def test_what_is_no_path_of_the_drive_is_refused() -> None:
    prior = MotionPrior(path(steps(5), start_s=1.7e9), PriorSettings())
    with pytest.raises(RegistrationError, match=r"does not cover the drive.*same clock"):
        prior.check_covers(0.1 * np.arange(10))
    # One that covers a part is taken.
    MotionPrior(path(steps(5), start_s=0.45), PriorSettings()).check_covers(0.1 * np.arange(20))
    with pytest.raises(RegistrationError, match="two poses"):
        MotionPrior(path(steps(1)), PriorSettings())
    with pytest.raises(SettingsError, match="kiss takes no prior"):
        make_odometry("kiss", OdometrySettings(), path(steps(3)))


def test_frames_without_sight_are_carried_by_the_prior(see: See, blind: See) -> None:
    """The camera turns sharply while it is blind: the last motion going on would be far off."""
    turn = make_transform(exp_so3(np.array([0.0, 0.08, 0.0])), np.array([0.0, 0.0, 0.3]))
    truth = list(steps(4))
    for _ in range(5):
        truth.append(truth[-1] @ turn)
    frames = [see(T, n) for n, T in enumerate(truth[:4])]
    frames += [blind(index=n) for n in range(4, len(truth))]
    alone = register(frames, None)
    carried = register(frames, path(np.stack(truth)))
    assert not alone[-1].health.ok
    assert off_m(alone[-1], truth[-1]) > 0.5
    assert all(result.health.ok for result in carried)
    assert "carried by the prior" in carried[-1].health.notes[0]
    # The prior is exact; what is left is the error of the seen motion before.
    assert off_m(carried[-1], truth[-1]) < 0.06


def test_a_prior_that_is_a_little_off_hardly_moves_what_is_seen(
    street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    """Wheels that are 3 % too large: features know better."""
    poses = street_poses.copy()
    poses[:, :3, 3] *= 1.03
    alone, led = (register(list(street), prior) for prior in (None, path(poses)))
    assert all(result.health.ok for result in led)
    assert off_m(led[-1], street_poses[-1]) < off_m(alone[-1], street_poses[-1]) + 0.02


def test_features_that_stand_still_do_not_outvote_the_wheels(see: See) -> None:
    """An image that stays the same while the wheels turn, as behind a lorry or a dirty lens."""
    still = [see(np.eye(4), 0)] * 3
    frames = [replace(f, pair=replace(f.pair, timestamp_s=0.1 * n)) for n, f in enumerate(still)]
    results = register(frames, path(steps(3)))
    assert off_m(results[-1], np.linalg.matrix_power(STEP, 2)) < 1e-6
    assert "features contradict the prior" in results[-1].health.notes[0]
    # Who is right is open, and the image is against the wheels.
    assert not results[-1].health.ok


AXES = {"camera": np.eye(4), "body": CAMERA_FROM_BODY}


@pytest.fixture(scope="module")
def frames(see: See) -> list[OdometryFrame]:
    return [see(T, n) for n, T in enumerate(steps(7))]


def prior(T_camera_body: np.ndarray, step: np.ndarray = STEP, count: int = 8) -> Trajectory:
    poses = steps(count, step) @ T_camera_body
    return Trajectory(invert(poses[0]) @ poses, 0.1 * np.arange(count))


@pytest.mark.parametrize("axes", AXES)
def test_the_axes_of_a_path_are_found(frames: list[OdometryFrame], axes: str) -> None:
    found = find_axes(prior(AXES[axes]), iter(frames), PriorSettings())
    assert found is not None
    assert found.axes == axes
    # The path is exact, so its own standard deviation of 3 % is never used up.
    assert found.sigmas[axes] < 1
    assert max(found.sigmas.values()) > 5


def test_a_body_near_the_camera_and_a_scale_two_per_cent_off_are_recognised(
    frames: list[OdometryFrame],
) -> None:
    lever = make_transform(exp_so3(np.array([0.02, 0.0, 0.03])), np.array([0.3, 0.5, -0.2]))
    step = STEP.copy()
    step[:3, 3] *= 1.02
    found = find_axes(prior(CAMERA_FROM_BODY @ lever, step), iter(frames), PriorSettings())
    assert found is not None
    assert found.axes == "body"


def test_a_path_of_other_axes_is_refused(frames: list[OdometryFrame]) -> None:
    backwards = make_transform(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    with pytest.raises(RegistrationError, match=r"does not fit what the cameras see.*body"):
        find_axes(prior(backwards), iter(frames), PriorSettings())


def test_without_motion_the_axes_stay_open(see: See) -> None:
    still = [see(np.eye(4), n) for n in range(4)]
    assert find_axes(prior(np.eye(4), np.eye(4)), iter(still), PriorSettings()) is None


def test_the_first_moving_frame_is_found_from_the_path_alone() -> None:
    moved = np.concatenate([np.zeros(20), 0.05 * np.arange(40)])
    poses = np.stack([make_transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in moved])
    path = Trajectory(poses, 0.1 * np.arange(60))
    # Of the frames until 0.3 m are covered, those before the path moves are of no use.
    assert first_moving(path, 0.1 * np.arange(5, 60), PriorSettings()) == 15
