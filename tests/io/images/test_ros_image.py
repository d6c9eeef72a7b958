"""Images of ROS messages are decoded to grey or RGB."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.io.images.image import pixels_of_ros_image

BAYER = {"r": 200, "g": 90, "b": 20}


@pytest.mark.parametrize(
    ("encoding", "pixel", "expected"),
    [("rgb8", [10, 20, 30], [10, 20, 30]), ("bgr8", [30, 20, 10], [10, 20, 30]),
     ("rgba8", [10, 20, 30, 255], [10, 20, 30]), ("bgra8", [30, 20, 10, 9], [10, 20, 30])],
)  # fmt: skip
def test_colours_of_a_message_become_rgb(encoding, pixel, expected):
    data = np.tile(np.array(pixel, np.uint8), 6)
    image = pixels_of_ros_image(data, encoding, (2, 3), 3 * len(pixel))
    np.testing.assert_array_equal(image, np.broadcast_to(expected, (2, 3, 3)))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_image_of_one_colour_gives_that_colour(pattern):
    tile = np.array([BAYER[letter] for letter in pattern], np.uint8).reshape(2, 2)
    image = pixels_of_ros_image(np.tile(tile, (4, 4)).ravel(), f"bayer_{pattern}8", (8, 8), 8)
    np.testing.assert_array_equal(image[2:6, 2:6], np.broadcast_to([200, 90, 20], (4, 4, 3)))


@pytest.mark.parametrize("big_endian", [False, True])
def test_sixteen_bits_are_scaled_in_either_order_of_bytes(big_endian):
    values = np.array([[0, 257, 65535]], ">u2" if big_endian else "<u2")
    data = np.frombuffer(values.tobytes(), np.uint8)
    image = pixels_of_ros_image(data, "mono16", (1, 3), 6, big_endian=big_endian)
    np.testing.assert_array_equal(image, [[0, 1, 255]])


@pytest.mark.parametrize(("encoding", "order"), [("yuv422_yuy2", "yuyv"), ("yuv422", "uyvy")])
def test_a_grey_yuv_image_is_grey(encoding, order):
    data = np.array([126 if letter == "y" else 128 for letter in order * 4], np.uint8)
    image = pixels_of_ros_image(data, encoding, (2, 4), 8)
    # Video levels: 16 is black, 235 white.
    np.testing.assert_allclose(image, 255 * (126 - 16) / 219, atol=1)


def test_a_message_with_too_few_bytes_is_refused():
    with pytest.raises(FormatError, match=r"too few bytes \(got 9 bytes, 6 per row, expected 4x2"):
        pixels_of_ros_image(np.zeros(9, np.uint8), "mono8", (2, 4), 6)
    # The last row needs no padding.
    assert pixels_of_ros_image(np.zeros(10, np.uint8), "mono8", (2, 4), 6).shape == (2, 4)
