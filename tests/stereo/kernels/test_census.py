"""Gradients and census: darker neighbours, bit by bit."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from recon.stereo.kernels.census import Descriptor, write_planes

Image = NDArray[np.uint8]
greys = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12))


def planes_reference(grey: NDArray[np.uint8], descriptor: Descriptor) -> NDArray[np.uint8]:
    """Reference implementation of `write_planes`: uint8 (``descriptor.planes``, H, W)."""
    height, width = grey.shape
    around = np.pad(grey.astype(np.int64), 1, mode="edge")
    slopes = around[:, 2:] - around[:, :-2]
    gradient = slopes[:-2] + 2 * slopes[1:-1] + slopes[2:]
    planes = np.zeros((descriptor.planes, height, width), np.uint8)
    planes[0] = np.clip(gradient, -descriptor.cap, descriptor.cap) + descriptor.cap
    around = np.pad(grey, ((descriptor.rows_radius,) * 2, (descriptor.radius,) * 2), mode="edge")
    bits = [
        around[dy : dy + height, dx : dx + width] < grey
        for dy in range(2 * descriptor.rows_radius + 1)
        for dx in range(2 * descriptor.radius + 1)
        if (dy, dx) != (descriptor.rows_radius, descriptor.radius)
    ]
    if bits:
        packed = np.packbits(np.stack(bits), axis=0, bitorder="little")
        planes[1 : 1 + len(packed)] = packed
    return planes


def planes_of(
    grey: Image, descriptor: Descriptor, place: int = 0, size: int | None = None
) -> Image:
    height, width = grey.shape
    grey.flags.writeable = False  # as that of a pair: kernels are compiled for it
    planes = np.full((height, descriptor.planes, width if size is None else size), 77, np.uint8)
    write_planes(grey, descriptor, place, 0, height, planes)
    return planes.transpose(1, 0, 2)


@given(greys, st.builds(Descriptor, st.integers(1, 127), st.integers(0, 4), st.integers(0, 4)))
def test_planes_equal_the_reference(grey: Image, descriptor: Descriptor) -> None:
    np.testing.assert_array_equal(planes_of(grey, descriptor), planes_reference(grey, descriptor))


@given(greys, st.integers(-30, 40), st.integers(1, 30))
def test_a_placed_row_is_continued_by_its_border(grey: Image, place: int, size: int) -> None:
    descriptor = Descriptor(127, 1, 1)
    columns = np.clip(np.arange(size) - place, 0, grey.shape[1] - 1)
    expected = planes_reference(grey, descriptor)[:, :, columns]
    np.testing.assert_array_equal(planes_of(grey, descriptor, place, size), expected)


@given(greys, st.integers(1, 127))
def test_gradients_are_those_of_opencv(grey: Image, cap: int) -> None:
    sobel = cv2.Sobel(grey, cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE)
    gradient = planes_of(grey, Descriptor(cap, 2, 2))[0]
    np.testing.assert_array_equal(gradient, np.clip(sobel, -cap, cap) + cap)


def test_census_of_one_bright_pixel_has_all_bits_there_and_none_elsewhere() -> None:
    grey = np.zeros((5, 5), np.uint8)
    grey[2, 2] = 9
    bits = np.unpackbits(planes_of(grey, Descriptor(127, 1, 1))[1:], axis=0).sum(axis=0)
    assert bits[2, 2] == 8
    assert bits.sum() == 8


def test_census_does_not_change_with_brightness_and_contrast() -> None:
    grey = np.random.default_rng(0).integers(0, 100, (20, 30), dtype=np.uint8)
    brighter = (2 * grey + 40).astype(np.uint8)
    descriptor = Descriptor(127, 2, 2)
    np.testing.assert_array_equal(
        planes_of(grey, descriptor)[1:], planes_of(brighter, descriptor)[1:]
    )
