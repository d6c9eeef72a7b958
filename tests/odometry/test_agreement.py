"""Every image patch is tested for consistency with a motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.odometry.checked import MIN_SHARE, Agreement, Sight, explain_motion, noise_sigma
from recon.odometry.protocol import OdometryFrame

See = Callable[..., OdometryFrame]
STEP = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([0.0, 0.0, 0.5]))


def ask(before: OdometryFrame, now: OdometryFrame, T_before_now: np.ndarray) -> Agreement:
    views = (Sight(frame.pair.left, frame.disparity) for frame in (before, now))
    return explain_motion(*views, T_before_now, now.pair.camera)


def scaled(T: np.ndarray, share: float) -> np.ndarray:
    return make_transform(T[:3, :3], share * T[:3, 3])


def turned(T: np.ndarray, angle_rad: float) -> np.ndarray:
    return T @ make_transform(exp_so3(np.array([0.0, angle_rad, 0.0])), np.zeros(3))


def test_the_true_motion_explains_nearly_every_patch(see: See) -> None:
    found = ask(see(np.eye(4)), see(STEP), STEP)
    assert found.informative >= 20
    assert found.share > 0.9


@pytest.mark.parametrize("wrong", [np.eye(4), scaled(STEP, 2.0), invert(STEP), turned(STEP, 0.05)])
def test_a_wrong_motion_does_not(wrong: np.ndarray, see: See) -> None:
    found = ask(see(np.eye(4)), see(STEP), wrong)
    assert found.informative >= 8
    assert found.share < MIN_SHARE


def test_another_exposure_changes_nothing(see: See) -> None:
    before, now = see(np.eye(4)), see(STEP)
    dim = np.rint(0.5 * now.pair.left + 20).astype(np.uint8)
    dimmed = replace(now, pair=replace(now.pair, left=dim))
    assert ask(before, dimmed, STEP).share == pytest.approx(ask(before, now, STEP).share, abs=0.05)


def test_an_image_without_texture_give_no_answer(blind: See) -> None:
    found = ask(blind(100), blind(100), np.eye(4))
    assert found.informative == 0
    assert np.isnan(found.share)


def test_an_image_that_is_dark_now_give_no_answer(see: See, blind: See) -> None:
    assert ask(see(np.eye(4)), blind(2), STEP).informative == 0


@pytest.mark.parametrize("direction", [(0, 1), (1, 0), (1, 1), (1, -1)])
def test_edges_of_one_direction_give_no_answer(direction: tuple[int, int], see: See) -> None:
    """Stripes look alike however far the camera went along them."""
    frame = see(np.eye(4))
    rows, columns = np.mgrid[0:160, 0:400]
    across = direction[0] * rows + direction[1] * columns
    stripes = np.rint(120 + 60 * np.sin(across / 4)).astype(np.uint8)
    striped = replace(frame, pair=replace(frame.pair, left=stripes))
    assert ask(striped, striped, np.eye(4)).informative == 0


def test_patches_are_counted_one_by_one(see: See) -> None:
    """Where half of the image is another one, half of the patches disagree."""
    before, now = see(np.eye(4)), see(STEP)
    mixed = now.pair.left.copy()
    mixed[:, 200:] = mixed[:, :199:-1]
    found = ask(before, replace(now, pair=replace(now.pair, left=mixed)), STEP)
    assert found.informative > 20
    assert 0.35 < found.share < 0.65


@pytest.mark.parametrize("sigma", [1.0, 3.0, 8.0])
def test_the_noise_of_an_image_is_found(sigma: float) -> None:
    ramp = np.tile(np.linspace(60, 190, 300), (200, 1))
    noisy = ramp + np.random.default_rng(3).normal(0.0, sigma, ramp.shape)
    grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    # 15 000 values tell their median to 1 %; rounding and whole steps of the median add 0.3.
    assert noise_sigma(grey) == pytest.approx(sigma, rel=0.1, abs=0.3)


def test_a_tiny_image_has_the_least_noise() -> None:
    assert noise_sigma(np.zeros((2, 2), np.uint8)) == 0.5
