"""Light that changes while a camera drives, and motions that explain an image equally well."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.geometry.se3 import make_transform
from recon.odometry import features
from recon.odometry.checked import CheckedOdometry
from recon.odometry.protocol import OdometryFrame
from recon.odometry.visual import VisualOdometry
from tests.odometry.conftest import See, off_m


def ahead(distance_m: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([0.0, 0.0, distance_m]))


def entrance(gain: float) -> np.ndarray:
    """The foot of a wall, lit from its left end, with a weak grain; the sky above is white.

    The exposure changes all but the sky, so that the whole image does not say by how much.
    """
    v, u = np.mgrid[0:160, 0:400].astype(np.float64)
    grain = cv2.GaussianBlur(np.random.default_rng(5).normal(size=v.shape), (0, 0), 1.0)
    light = np.where(v > 130 - 0.15 * u, 40.0, 90.0) * np.exp(-u / 250) * (1 + 0.1 * grain)
    grey = np.where(v < 50, 255.0, gain * light)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("gain", [0.7, 1.0, 1.4])
def test_features_on_an_edge_do_not_slide_to_where_it_is_as_bright(gain):
    u = np.arange(60, 340, 10, dtype=np.float32)
    uv = np.column_stack([u, 130 - np.float32(0.15) * u])
    there, found = features.follow(entrance(1.0), entrance(gain), uv, uv)
    assert found.mean() > 0.9
    # With one gain for the whole image they slide by 40 px.
    assert np.median(np.abs(there - uv)[found].max(axis=1)) < 0.2


def test_black_and_white_images_are_followed_nowhere_without_a_warning():
    uv = np.array([[50.0, 50.0]], np.float32)
    for level in (0, 255):
        blank = np.full((100, 100), level, np.uint8)
        assert not features.follow(blank, entrance(1.0)[:100, :100], uv, uv)[1].any()


def split(see: See, columns: int, left_m: float, right_m: float) -> OdometryFrame:
    """A frame whose left columns show the street from one place, and the others from another."""
    frame, other = see(ahead(left_m), 5), see(ahead(right_m), 5)
    grey, values = frame.pair.left.copy(), frame.disparity.values.copy()
    grey[:, columns:] = other.pair.left[:, columns:]
    values[:, columns:] = other.disparity.values[:, columns:]
    pair = replace(frame.pair, left=grey, right=grey)
    return OdometryFrame(pair, replace(frame.disparity, values=values))


@pytest.fixture(scope="module")
def begun(see):
    """The state of an odometry after five frames, 0.4 m apart."""
    odometry = CheckedOdometry(VisualOdometry())
    for number in range(5):
        odometry.register(see(ahead(0.4 * number), number))
    return odometry.state()


@pytest.mark.parametrize("columns", [130, 160])
def test_of_two_motions_that_explain_an_image_none_is_trusted(see, begun, columns):
    """The smaller part of the image goes on as before; most of the other jumps 1 m ahead."""
    odometry = CheckedOdometry(VisualOdometry())
    odometry.restore(begun)
    result = odometry.register(split(see, columns, 2.0, 2.6))
    assert min(off_m(result, ahead(2.0)), off_m(result, ahead(2.6))) < 0.02
    assert not result.health.ok
    # About half of the 0.6 m between them.
    assert 0.15 < result.health.sigma_m < 0.35
    assert result.health.notes[0] == "another motion explains the image as well"


def test_a_motion_that_changes_is_trusted_where_all_of_the_image_shows_it(see, begun):
    odometry = CheckedOdometry(VisualOdometry())
    odometry.restore(begun)
    result = odometry.register(see(ahead(2.6), 5))
    assert off_m(result, ahead(2.6)) < 0.02
    assert result.health.ok
    assert result.health.notes == ()
    assert result.health.sigma_m < 0.02
