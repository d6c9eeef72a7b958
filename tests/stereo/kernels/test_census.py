"""Gradients and census: darker neighbours, bit by bit."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.values.arrays import UInt8
from recon.stereo.kernels.path_costs import CENSUS_RADIUS, GRADIENT_CAP, PLANES, write_planes

greys = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12))


def planes_reference(grey: UInt8) -> UInt8:
    """Return uint8 (PLANES, H, W) as `write_planes` writes them; gradients are those of OpenCV."""
    (height, width), side = grey.shape, 2 * CENSUS_RADIUS + 1
    sobel = cv2.Sobel(grey, cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE)
    gradient = np.clip(sobel, -GRADIENT_CAP, GRADIENT_CAP) + GRADIENT_CAP
    around = np.pad(grey, CENSUS_RADIUS, mode="edge")
    places = [(dy, dx) for dy, dx in np.ndindex(side, side) if (dy, dx) != (CENSUS_RADIUS,) * 2]
    darker = [around[dy : dy + height, dx : dx + width] < grey for dy, dx in places]
    bits = np.packbits(np.stack(darker), axis=0, bitorder="little")
    return np.concatenate([gradient[None].astype(np.uint8), bits])


def planes_of(grey: UInt8, place: int = 0, size: int | None = None) -> UInt8:
    height, width = grey.shape
    grey.flags.writeable = False  # as that of a pair: kernels are compiled for it
    planes = np.full((height, PLANES, width if size is None else size), 77, np.uint8)
    write_planes(grey, place, 0, height, planes)
    return planes.transpose(1, 0, 2)


@given(greys)
def test_planes_equal_the_reference(grey: UInt8) -> None:
    np.testing.assert_array_equal(planes_of(grey), planes_reference(grey))


@given(greys, st.integers(-30, 40), st.integers(1, 30))
def test_a_placed_row_is_continued_by_its_border(grey: UInt8, place: int, size: int) -> None:
    columns = np.clip(np.arange(size) - place, 0, grey.shape[1] - 1)
    expected = planes_reference(grey)[:, :, columns]
    np.testing.assert_array_equal(planes_of(grey, place, size), expected)


def test_census_of_one_bright_pixel_has_all_bits_there_and_none_elsewhere() -> None:
    grey = np.zeros((5, 5), np.uint8)
    grey[2, 2] = 9
    bits = np.unpackbits(planes_of(grey)[1:], axis=0).sum(axis=0)
    assert bits[2, 2] == bits.sum() == 24


def test_census_does_not_change_with_brightness_and_contrast() -> None:
    grey = np.random.default_rng(0).integers(0, 100, (20, 30), dtype=np.uint8)
    brighter = (2 * grey + 40).astype(np.uint8)
    np.testing.assert_array_equal(planes_of(grey)[1:], planes_of(brighter)[1:])
