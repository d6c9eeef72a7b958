from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.odometry.motion import Motion, part_of

STEP = make_transform(exp_so3(np.array([0.0, 0.03, 0.01])), np.array([0.1, 0.0, 1.2]))


def test_with_known_times_the_velocity_goes_on() -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1)
    np.testing.assert_allclose(motion.predict(0.2), STEP @ STEP, atol=1e-12)
    np.testing.assert_allclose(motion.predict(0.4), STEP @ part_of(STEP, 3.0), atol=1e-12)


@pytest.mark.parametrize("time_s", [0.0, 0.1, 1000.0, -5.0])
def test_times_that_give_no_answer_repeat_the_last_motion(time_s: float) -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1)
    np.testing.assert_allclose(motion.predict(time_s), STEP @ STEP, atol=1e-12)


def test_sources_without_times_repeat_the_last_motion() -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.0)
    np.testing.assert_allclose(motion.predict(0.0), STEP @ STEP, atol=1e-12)


def test_frames_that_are_not_seen_keep_the_velocity() -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1).drifted(0.2).drifted(0.3)
    np.testing.assert_allclose(motion.T_world_camera, np.linalg.matrix_power(STEP, 3), atol=1e-12)
    np.testing.assert_allclose(motion.predict(0.4), np.linalg.matrix_power(STEP, 4), atol=1e-12)


def test_half_a_motion_done_twice_turns_as_far() -> None:
    half = part_of(STEP, 0.5)
    np.testing.assert_allclose((half @ half)[:3, :3], STEP[:3, :3], atol=1e-12)
