from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from recon.core.errors import ShapeError
from recon.stereo.rectify.grey import GreyMode, to_grey

IMAGES = arrays(np.uint8, st.tuples(st.integers(1, 8), st.integers(1, 8), st.just(3)))
MODES: tuple[GreyMode, ...] = ("bt601", "mean", "paper")


@given(image=IMAGES)
def test_bt601_is_the_weighted_sum_of_the_norm(image: np.ndarray) -> None:
    exact = image @ np.array([0.299, 0.587, 0.114])
    # Rounding to nearest, and 1/2^14 steps of the weights in OpenCV's integers.
    assert np.abs(to_grey(image) - exact).max() < 0.52


@given(image=IMAGES)
def test_bt601_is_what_opencv_gives_within_a_level(image: np.ndarray) -> None:
    reference = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(to_grey(image) - reference).max() <= 1


@given(image=IMAGES)
def test_mean_is_rounded_to_nearest_and_ignores_the_order_of_channels(image: np.ndarray) -> None:
    np.testing.assert_array_equal(to_grey(image, "mean"), np.rint(image.mean(axis=2)))
    np.testing.assert_array_equal(to_grey(image, "mean"), to_grey(image[:, :, ::-1], "mean"))


@given(image=IMAGES)
def test_paper_is_equation_6_as_printed_clipped_at_white(image: np.ndarray) -> None:
    red, green, blue = (image[:, :, i].astype(float) for i in range(3))
    printed = 0.299 * red + 0.587 * green + 0.144 * blue
    np.testing.assert_allclose(to_grey(image, "paper"), np.clip(printed, 0, 255), atol=0.5 + 1e-9)


def test_the_misprint_of_the_paper_makes_grey_brighter_and_white_clip() -> None:
    image = np.array([[[100, 100, 100], [255, 255, 255], [0, 0, 200]]], dtype=np.uint8)
    assert to_grey(image, "bt601").tolist() == [[100, 255, 23]]
    assert to_grey(image, "paper").tolist() == [[103, 255, 29]]


@pytest.mark.parametrize("mode", MODES)
def test_a_grey_image_passes_unchanged_in_every_mode(mode: GreyMode) -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    np.testing.assert_array_equal(to_grey(grey, mode), grey)


@pytest.mark.parametrize("mode", MODES)
def test_read_only_and_strided_images_are_taken(mode: GreyMode) -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    strided = image[::2, ::-1]
    strided.flags.writeable = False
    np.testing.assert_array_equal(to_grey(strided, mode), to_grey(strided.copy(), mode))


@pytest.mark.parametrize("image", [np.zeros((2, 2, 4), np.uint8), np.zeros((2, 2)), np.zeros(3)])
def test_what_is_no_image_is_refused(image: np.ndarray) -> None:
    with pytest.raises(ShapeError, match="image has the wrong dtype or shape"):
        to_grey(image)
