"""A pose is not trusted if it is uncertain or contradicts the images."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.core.geometry.se3 import make_transform
from recon.core.values import RectifiedPair
from recon.odometry.checked import CheckedOdometry
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult
from recon.odometry.registry import make_odometry
from recon.sources.synthetic import SyntheticSource
from recon.stereo.match.registry import make_matcher
from recon.street.settings import StreetScene

See = Callable[..., OdometryFrame]


class Says:
    """An odometry with prescribed results."""

    def __init__(self, poses: np.ndarray, health: OdometryHealth) -> None:
        self._results = iter([OdometryResult(T, health) for T in poses])

    def register(self, frame: OdometryFrame) -> OdometryResult:
        return next(self._results)


def last_health(
    frames: list[OdometryFrame], poses: np.ndarray, health: OdometryHealth
) -> OdometryHealth:
    odometry = CheckedOdometry(Says(poses, health))
    results = [odometry.register(frame) for frame in frames]
    np.testing.assert_array_equal(results[-1].T_world_camera, poses[-1])
    return results[-1].health


def forward(*places_m: float) -> np.ndarray:
    return np.stack([make_transform(np.eye(3), np.array([0.0, 0.0, z])) for z in places_m])


@pytest.fixture
def half_a_metre(see: See) -> list[OdometryFrame]:
    return [see(T, index) for index, T in enumerate(forward(0.0, 0.5))]


def test_a_motion_that_the_image_bears_out_is_trusted(half_a_metre: list[OdometryFrame]) -> None:
    sure = OdometryHealth(sigma_m=0.01)
    assert last_health(half_a_metre, forward(0.0, 0.5), sure) == sure


def test_a_confident_motion_that_the_image_is_against_is_not(
    half_a_metre: list[OdometryFrame],
) -> None:
    health = last_health(half_a_metre, forward(0.0, 0.0), OdometryHealth(sigma_m=0.01))
    assert not health.ok
    assert "of the image moved like that" in health.notes[-1]


def test_a_motion_that_is_hardly_known_is_not(half_a_metre: list[OdometryFrame]) -> None:
    health = last_health(half_a_metre, forward(0.0, 0.5), OdometryHealth(sigma_m=0.3))
    assert not health.ok
    assert health.notes == ("the motion is known to 0.30 m only",)


def test_a_motion_without_a_deviation_needs_an_image_that_decides(blind: See) -> None:
    frames = [blind(100, index) for index in range(2)]
    health = last_health(frames, forward(0.0, 0.5), OdometryHealth())
    assert not health.ok
    assert "can distinguish motions" in health.notes[-1]


def test_what_was_not_measured_is_not_doubted_twice(half_a_metre: list[OdometryFrame]) -> None:
    lost = OdometryHealth(ok=False, notes=("lost",))
    assert last_health(half_a_metre, forward(0.0, 0.0), lost) == lost


def test_the_first_frame_has_nothing_to_be_compared_with(see: See) -> None:
    assert last_health([see(np.eye(4))], forward(0.0), OdometryHealth()).ok


def test_a_small_image_is_trusted_from_its_first_motion() -> None:
    """With 27 features that fit to a twentieth of a pixel; its error is 6 mm."""
    street = StreetScene(frames=2, width_px=256, height_px=96, focal_px=150.0)
    odometry, matcher = make_odometry("visual"), make_matcher("sad")
    for index, pair in enumerate(SyntheticSource(street)):
        left, right = (np.rint(x.mean(axis=2)).astype(np.uint8) for x in (pair.left, pair.right))
        rectified = RectifiedPair(left, right, SyntheticSource(street).calibration, index=index)
        result = odometry.register(OdometryFrame(rectified, matcher.match(rectified)))
    assert result.health.ok
    assert 0.006 < result.health.sigma_m < 0.1
