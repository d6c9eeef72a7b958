"""A pose is not trusted if it is uncertain or if the patches of the images contradict it."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import RectifiedPair
from recon.odometry import checked
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult
from recon.odometry.registry import make_odometry
from recon.sources.synthetic import SyntheticSource
from recon.stereo.match.registry import make_matcher
from recon.stereo.rectify.rectifier import noise_sigma
from recon.street.settings import StreetScene
from tests.odometry.conftest import STEP


class Says:
    """An odometry with prescribed results."""

    def __init__(self, poses: np.ndarray, health: OdometryHealth) -> None:
        self._results = iter([OdometryResult(T, health) for T in poses])

    def register(self, frame: OdometryFrame) -> OdometryResult:
        return next(self._results)


def last_health(frames, poses, health):
    odometry = checked.CheckedOdometry(Says(poses, health))
    results = [odometry.register(frame) for frame in frames]
    np.testing.assert_array_equal(results[-1].T_world_camera, poses[-1])
    return results[-1].health


def forward(*places_m: float) -> np.ndarray:
    return np.stack([make_transform(np.eye(3), np.array([0.0, 0.0, z])) for z in places_m])


@pytest.fixture
def half_a_metre(see):
    return [see(T, index) for index, T in enumerate(forward(0.0, 0.5))]


SURE = OdometryHealth(sigma_m=0.01)
LOST = OdometryHealth(ok=False, notes=("lost",))


@pytest.mark.parametrize(
    ("said_m", "stated", "note"),
    [
        (0.5, SURE, None),
        (0.0, SURE, "of the image moved like that"),
        (0.5, OdometryHealth(sigma_m=0.3), "the motion is known to 0.3 m only"),
        # What was not measured is not doubted twice.
        (0.0, LOST, None),
        (0.0, OdometryHealth(begins=True), None),
    ],
)
def test_a_motion_is_trusted_that_is_known_and_that_the_image_bears_out(
    half_a_metre, said_m, stated, note
):
    health = last_health(half_a_metre, forward(0.0, said_m), stated)
    if note is None:
        assert health == stated
    else:
        assert not health.ok
        assert note in health.notes[-1]


def test_a_motion_without_a_deviation_needs_an_image_that_decides(blind):
    frames = [blind(100, index) for index in range(2)]
    health = last_health(frames, forward(0.0, 0.5), OdometryHealth())
    assert not health.ok
    assert "can distinguish motions" in health.notes[-1]
    # The first frame has nothing to be compared with.
    assert last_health(frames[:1], forward(0.0), OdometryHealth()).ok


def test_a_small_image_is_trusted_from_its_first_motion():
    """With 27 features that fit to a twentieth of a pixel; its error is 6 mm."""
    street = StreetScene(frames=2, width_px=256, height_px=96, focal_px=150.0)
    odometry, matcher = make_odometry("visual"), make_matcher("sad")
    for index, pair in enumerate(SyntheticSource(street)):
        left, right = (np.rint(x.mean(axis=2)).astype(np.uint8) for x in (pair.left, pair.right))
        rectified = RectifiedPair(left, right, SyntheticSource(street).calibration, index=index)
        result = odometry.register(OdometryFrame(rectified, matcher.match(rectified)))
    assert result.health.ok
    assert 0.006 < result.health.sigma_m < 0.1


def ask(before: OdometryFrame, now: OdometryFrame, T_before_now: np.ndarray) -> checked.Agreement:
    views = (checked.Sight(frame.pair.left, frame.disparity) for frame in (before, now))
    return checked.explain_motion(*views, T_before_now, now.pair.camera)


TURNED = STEP @ make_transform(exp_so3(np.array([0.0, 0.05, 0.0])), np.zeros(3))
FAST = make_transform(STEP[:3, :3], 2.0 * STEP[:3, 3])


def test_the_true_motion_explains_nearly_every_patch_in_any_exposure(see):
    found = ask(see(np.eye(4)), see(STEP), STEP)
    assert found.informative >= 20
    assert found.ratio > 0.9
    before, now = see(np.eye(4)), see(STEP)
    dim = np.rint(0.5 * now.pair.left + 20).astype(np.uint8)
    dimmed = replace(now, pair=replace(now.pair, left=dim))
    assert ask(before, dimmed, STEP).ratio == pytest.approx(ask(before, now, STEP).ratio, abs=0.05)


@pytest.mark.parametrize("wrong", [np.eye(4), FAST, invert(STEP), TURNED])
def test_a_wrong_motion_does_not(wrong, see):
    found = ask(see(np.eye(4)), see(STEP), wrong)
    assert found.informative >= 8
    assert found.ratio < checked.MIN_RATIO


def test_an_image_without_texture_or_dark_now_gives_no_answer(see, blind):
    found = ask(blind(100), blind(100), np.eye(4))
    assert found.informative == 0
    assert np.isnan(found.ratio)
    assert ask(see(np.eye(4)), blind(2), STEP).informative == 0


@pytest.mark.parametrize("direction", [(0, 1), (1, 0), (1, 1), (1, -1)])
def test_edges_of_one_direction_give_no_answer(direction, see):
    """Stripes look alike however far the camera went along them."""
    frame = see(np.eye(4))
    rows, columns = np.mgrid[0:160, 0:400]
    across = direction[0] * rows + direction[1] * columns
    stripes = np.rint(120 + 60 * np.sin(across / 4)).astype(np.uint8)
    striped = replace(frame, pair=replace(frame.pair, left=stripes))
    assert ask(striped, striped, np.eye(4)).informative == 0


def test_patches_are_counted_one_by_one(see):
    """Where half of the image is another one, half of the patches disagree."""
    before, now = see(np.eye(4)), see(STEP)
    mixed = now.pair.left.copy()
    mixed[:, 200:] = mixed[:, :199:-1]
    found = ask(before, replace(now, pair=replace(now.pair, left=mixed)), STEP)
    assert found.informative > 20
    assert 0.35 < found.ratio < 0.65


@pytest.mark.parametrize("sigma", [1.0, 3.0, 8.0])
def test_the_noise_of_an_image_is_found(sigma):
    ramp = np.tile(np.linspace(60, 190, 300), (200, 1))
    noisy = ramp + np.random.default_rng(3).normal(0.0, sigma, ramp.shape)
    grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    # 15 000 values tell their median to 1 %; rounding and whole steps of the median add 0.3.
    assert noise_sigma(grey) == pytest.approx(sigma, rel=0.1, abs=0.3)
    assert noise_sigma(np.zeros((2, 2), np.uint8)) == 0.5  # the least
