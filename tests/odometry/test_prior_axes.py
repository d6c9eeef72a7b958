"""The axes of an external trajectory are found by comparing it with what the cameras see."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.odometry.prior_axes import find_axes, first_moving
from recon.odometry.protocol import OdometryFrame
from recon.odometry.settings import PriorSettings

See = Callable[..., OdometryFrame]

STEP = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([0.0, 0.0, 0.5]))
CAMERA_FROM_BODY = make_transform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3)
)
AXES = {"camera": np.eye(4), "body": CAMERA_FROM_BODY}


@pytest.fixture(scope="module")
def frames(see: See) -> list[OdometryFrame]:
    return [see(np.linalg.matrix_power(STEP, n), n) for n in range(7)]


def prior(T_camera_body: np.ndarray, step: np.ndarray = STEP, count: int = 8) -> Trajectory:
    poses = np.stack([np.linalg.matrix_power(step, n) @ T_camera_body for n in range(count)])
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


def test_a_path_of_other_axes_is_refused_in_one_line(frames: list[OdometryFrame]) -> None:
    backwards = make_transform(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    with pytest.raises(RegistrationError, match="does not fit what the cameras see") as error:
        find_axes(prior(backwards), iter(frames), PriorSettings())
    assert "camera" in str(error.value)
    assert "body" in str(error.value)
    assert "\n" not in str(error.value)


def test_without_motion_the_axes_stay_open(see: See) -> None:
    still = [see(np.eye(4), n) for n in range(4)]
    assert find_axes(prior(np.eye(4), np.eye(4)), iter(still), PriorSettings()) is None


def test_the_first_moving_frame_is_found_from_the_path_alone() -> None:
    moved = np.concatenate([np.zeros(20), 0.05 * np.arange(40)])
    poses = np.stack([make_transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in moved])
    path = Trajectory(poses, 0.1 * np.arange(60))
    # Of the frames until 0.3 m are covered, those before the path moves are of no use.
    assert first_moving(path, 0.1 * np.arange(5, 60), PriorSettings()) == 15
