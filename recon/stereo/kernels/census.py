"""Descriptors of pixels: the horizontal gradient and the census transform.

The census, one bit per neighbour that is darker, is invariant under any change of brightness that
keeps the order of grey levels.

Ref: R. Zabih, J. Woodfill, "Non-parametric local transforms for computing visual
correspondence", ECCV 1994.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel
from recon.stereo.kernels.borders import continue_row
from recon.stereo.kernels.simd import (
    LANES,
    load_row,
    splat,
    store_row,
    where_less,
)

PLANES: Final = 3
"""Planes of bits come in threes, which one loop compares: a census of 5 by 5 needs three."""


class Descriptor(NamedTuple):
    """How pixels are described.

    Attributes:
        cap: Horizontal gradients (Sobel units) are clipped to plus or minus this; at most 127.
        rows_radius: Half height of the census, pixels.
        radius: Half width of the census, pixels.
    """

    cap: int
    rows_radius: int
    radius: int

    @property
    def planes(self) -> int:
        """Number of planes: one of gradients, and three or more of bits."""
        neighbours = (2 * self.rows_radius + 1) * (2 * self.radius + 1) - 1
        return 1 + PLANES * max(1, -(-neighbours // (8 * PLANES)))


@kernel
def write_planes(
    grey: NDArray[np.uint8],
    descriptor: Descriptor,
    place: int,
    first: int,
    end: int,
    planes: NDArray[np.uint8],
) -> None:
    """Write the gradients and the census of some rows, continued by those of the border pixels.

    Plane 0 is the gradient plus the cap. Bit ``n % 8`` of plane ``1 + n // 8`` is set where
    neighbour ``n`` (row by row, the middle left out) is darker than the pixel; unused bits are 0.

    Args:
        grey: uint8 (H, W); continued by its border pixels.
        descriptor: How pixels are described.
        place: Column of the planes that holds column 0 of the image; may lie outside them.
        first: First row to do.
        end: The row after the last.
        planes: Written: uint8 (H, ``descriptor.planes``, R), the rows.
    """
    height, width = grey.shape
    rows_radius, radius = max(descriptor.rows_radius, 1), max(descriptor.radius, 1)
    # Row y is at place y % N of the rows around, column x at radius + x.
    around = np.empty((2 * rows_radius + 1, radius + width + radius + LANES), np.uint8)
    row = np.empty((planes.shape[1], width + LANES), np.uint8)
    for y in range(first - 2 * rows_radius, end):
        line = min(max(y + rows_radius, 0), height - 1)
        continue_row(grey[line], radius, around[(y + rows_radius) % around.shape[0]])
        if y >= first:
            _write_gradient(around, y, radius, descriptor.cap, row[0, :width])
            _write_census(around, y, radius, descriptor, width, row)
            for n in range(row.shape[0]):
                continue_row(row[n, :width], place, planes[y, n])


@kernel
def _write_gradient(
    around: NDArray[np.uint8], y: int, radius: int, cap: int, gradient: NDArray[np.uint8]
) -> None:
    """Write the clipped Sobel gradient of a row."""
    rows, most = around.shape[0], np.int16(cap)
    above, same, below = around[(y - 1) % rows], around[y % rows], around[(y + 1) % rows]
    above_left, above_right = above[radius - 1 :], above[radius + 1 :]
    same_left, same_right = same[radius - 1 :], same[radius + 1 :]
    below_left, below_right = below[radius - 1 :], below[radius + 1 :]
    for x in range(gradient.size):
        middle = np.int16(np.int16(same_right[x]) - np.int16(same_left[x]))
        upper = np.int16(np.int16(above_right[x]) - np.int16(above_left[x]))
        lower = np.int16(np.int16(below_right[x]) - np.int16(below_left[x]))
        slope = np.int16(np.int16(upper + lower) + np.int16(middle + middle))
        gradient[x] = np.uint8(np.int16(min(max(slope, np.int16(-most)), most) + most))


@kernel
def _write_census(
    around: NDArray[np.uint8],
    y: int,
    radius: int,
    descriptor: Descriptor,
    width: int,
    planes: NDArray[np.uint8],
) -> None:
    """Write the bits of a row."""
    planes[1:] = np.uint8(0)
    rows, none, first = around.shape[0], splat(np.uint8(0)), splat(np.uint8(1))
    for x in range(0, width, LANES):
        middle = load_row(around, y % rows, radius + x)
        n, bits, bit = 0, none, first
        for dy in range(-descriptor.rows_radius, descriptor.rows_radius + 1):
            line = (y + dy) % rows
            for dx in range(-descriptor.radius, descriptor.radius + 1):
                if dy != 0 or dx != 0:
                    neighbour = load_row(around, line, radius + dx + x)
                    bits, bit = where_less(neighbour, middle, bits + bit, bits), bit + bit
                    n += 1
                    if n % 8 == 0:
                        store_row(planes, n // 8, x, bits)
                        bits, bit = none, first
        if n % 8 > 0:
            store_row(planes, n // 8 + 1, x, bits)
