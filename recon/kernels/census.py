"""Census: which neighbours of a pixel are darker, one bit each.

It stays what it is under any change of brightness that keeps the order of grey levels.

Ref: R. Zabih, J. Woodfill, "Non-parametric local transforms for computing visual
correspondence", ECCV 1994.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import njit, types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

PLANES: Final = 3
"""Planes come in threes: 5 by 5 has three, and fewer loops are faster ones."""


def count_bits(bits: Any) -> Any:
    """Number of bits of a uint8 that are set."""
    return np.uint8(int(bits).bit_count())


@intrinsic
def _population_count(_: Any, bits: Any) -> Any:
    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return (types.uint8(types.uint8), generate) if bits == types.uint8 else None


@overload(count_bits)
def _count_bits_compiled(bits: Any) -> Any:
    """Let compiled code count by the instruction of the processor, if it has one."""

    def count(bits: Any) -> Any:
        return _population_count(bits)

    return count if bits == types.uint8 else None


def census_planes(grey: NDArray[np.uint8], rows_radius: int, radius: int) -> NDArray[np.uint8]:
    """Compare each pixel with the neighbours around it.

    Args:
        grey: uint8 (H, W); continued by its border pixels.
        rows_radius: Rows above and below that are compared.
        radius: Columns to each side that are compared.

    Returns:
        uint8 (B, H, W). Bit ``n % 8`` of plane ``n // 8`` is set where neighbour ``n`` (row by
        row, the middle left out) is darker than the pixel; unused bits are 0.
    """
    height, width = grey.shape
    neighbours = (2 * rows_radius + 1) * (2 * radius + 1) - 1
    planes = np.zeros((number_of_planes(neighbours), height, width), np.uint8)
    around = np.pad(grey, ((rows_radius,) * 2, (radius,) * 2), mode="edge")
    n = 0
    for dy in range(2 * rows_radius + 1):
        for dx in range(2 * radius + 1):
            if (dy, dx) != (rows_radius, radius):
                neighbour = around[dy : dy + height, dx : dx + width]
                _set_bits(grey, neighbour, np.uint8(1 << (n % 8)), planes[n // 8])
                n += 1
    return planes


def number_of_planes(neighbours: int) -> int:
    """Planes for so many bits."""
    return (neighbours + 8 * PLANES - 1) // (8 * PLANES) * PLANES


@njit(cache=True, nogil=True)
def _set_bits(
    grey: NDArray[np.uint8], neighbour: NDArray[np.uint8], bit: np.uint8, plane: NDArray[np.uint8]
) -> None:
    """Set one bit wherever the neighbour is darker."""
    for y in range(grey.shape[0]):
        for x in range(grey.shape[1]):
            darker = bit if neighbour[y, x] < grey[y, x] else np.uint8(0)
            plane[y, x] = np.uint8(plane[y, x] | darker)


def census_planes_reference(
    grey: NDArray[np.uint8], rows_radius: int, radius: int
) -> NDArray[np.uint8]:
    """The plain-numpy twin of `census_planes`."""
    height, width = grey.shape
    around = np.pad(grey, ((rows_radius,) * 2, (radius,) * 2), mode="edge")
    planes = np.zeros((0, height, width), np.uint8)
    bits = [
        around[dy : dy + height, dx : dx + width] < grey
        for dy in range(2 * rows_radius + 1)
        for dx in range(2 * radius + 1)
        if (dy, dx) != (rows_radius, radius)
    ]
    if bits:
        planes = np.packbits(np.stack(bits), axis=0, bitorder="little")
    unused = number_of_planes(len(bits)) - len(planes)
    return np.pad(planes, ((0, unused), (0, 0), (0, 0)))
