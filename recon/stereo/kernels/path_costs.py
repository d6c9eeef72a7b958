"""Matching costs of all candidates of a row: gradients and census over a window, in uint8.

A row of costs is an array (candidates, W): the pixels of a candidate lie side by side, so vector
registers are filled along the row and only its end needs padding. Sums over the window's width are
kept for as many rows as the window is high. The census, one bit per neighbour that is darker, is
invariant under any change of brightness that keeps the order of grey levels.

Ref: R. Zabih, J. Woodfill, "Non-parametric local transforms for computing visual
correspondence", ECCV 1994.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import UInt8, UInt16, kernel
from recon.stereo.kernels.minima import continue_row
from recon.stereo.kernels.simd.vectors import (
    LANES,
    Vector,
    absolute_difference,
    differing_bits,
    load_row,
    narrow,
    smaller,
    splat,
    store_row,
    where_less,
    widen,
)

GRADIENT_CAP: Final = 127  # horizontal gradients (Sobel units) are clipped to plus or minus this
CENSUS_RADIUS: Final = 2  # half the square of the census, in pixels: its 24 bits fill three planes
PLANES: Final = 4  # one of gradients, and three of bits
ALIGNMENT: Final = 64  # bytes of a cache line
BLOCK: Final = 16  # candidates done at a time: their rows of the window stay in the cache


class Views(NamedTuple):
    """Both images, as the costs compare them."""

    grey: UInt8  # (H, W), the left image
    left: UInt8  # (H, PLANES, R), its planes, written by `write_views`
    right: UInt8  # (H, PLANES, R + P - 1), those of the right image


class Window(NamedTuple):
    """The window that costs are summed over, and how sums are scaled to uint8.

    The sum over the width is shifted right by ``row_shift``; the sum of those over the height is
    multiplied by ``factor`` and shifted right by ``shift``. `scaled_window` chooses the three.
    """

    radius: int  # half width of the window, pixels: it is ``2·radius + 1`` wide
    rows_radius: int  # half height of the window, pixels
    gradient_cap: int  # largest difference of gradients that counts
    row_shift: int  # bits; the shifted sum over the width fits into uint8
    factor: int  # the sum over the height times this fits into uint16
    shift: int  # bits
    top: int  # the largest cost; at most 253

    @property
    def levels(self) -> float:
        """Steps of a path cost for one step of a pixel's cost."""
        pixels = (2 * self.radius + 1) * (2 * self.rows_radius + 1)
        return pixels * self.factor * 2.0 ** -(self.row_shift + self.shift)


class CostRows(NamedTuple):
    """Scratch memory for the sums over a window of C columns."""

    pixels: UInt8  # (BLOCK, R + LANES), costs of single pixels
    rows: UInt8  # (2·rows_radius + 1, BLOCK, C), a ring: sums over the width, of each row
    sums: UInt16  # (BLOCK, C), sums of those over the height


def padded(number: int) -> int:
    """Return the number, rounded up to whole vectors."""
    return -(-number // LANES) * LANES


def aligned(shape: tuple[int, ...], kind: type[np.uint8 | np.uint16] = np.uint8) -> NDArray[Any]:
    """Return zeros that start at a cache line, so that loads of whole vectors cross none."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    memory = np.zeros(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(kind).reshape(shape)


def scaled_window(
    radius: int, rows_radius: int, gradient_cap: int, largest: int, levels: float
) -> Window:
    """Return a window whose costs are about ``levels`` times the mean cost of its pixels.

    ``largest`` is the largest cost of one pixel.
    """
    width, height = 2 * radius + 1, 2 * rows_radius + 1
    row_shift = max(0, (width * largest).bit_length() - 8)
    most = (width * largest >> row_shift) * height
    top = largest * levels
    # The finest scale that 16 bits hold.
    shift = max(0, int(np.log2(65535 / top)))
    factor = max(1, int(top * 2**shift / most))
    return Window(
        radius, rows_radius, gradient_cap, row_shift, factor, shift, most * factor >> shift
    )


def empty_planes(height: int, width: int, radius: int, ndisp: int) -> tuple[UInt8, UInt8]:
    """Return memory for `Views.left` and `Views.right`."""
    # A band may start at any column, and its last vector reads beyond its end.
    reach = padded(width + 2 * radius) + LANES
    left, right = (height, PLANES, reach), (height, PLANES, reach + ndisp - 1)
    return np.empty(left, np.uint8), np.empty(right, np.uint8)


def write_views(right: UInt8, radius: int, minimum: int, rows: range, views: Views) -> None:
    """Write the planes of some rows of both images, for windows of a half width.

    Column ``x`` of the left planes is compared, as candidate ``k``, with column ``x - k + P - 1``
    of the right ones.
    """
    place = radius + minimum + views.right.shape[2] - views.left.shape[2]
    write_planes(views.grey, radius, rows.start, rows.stop, views.left)
    write_planes(right, place, rows.start, rows.stop, views.right)


def empty_cost_rows(columns: int, window: Window) -> CostRows:
    """Return memory for `write_costs`; columns is a multiple of `LANES`."""
    return CostRows(
        aligned((BLOCK, padded(columns + 2 * window.radius) + LANES)),
        aligned((2 * window.rows_radius + 1, BLOCK, columns)),
        aligned((BLOCK, columns), np.uint16),
    )


WriteCosts: TypeAlias = Callable[[tuple[int, int], int, int, UInt8], None]
"""Writes the costs of columns ``(start, end)`` of rows ``top`` to ``bottom - 1`` to a ring, uint8
(N, P, C), as `write_costs` does."""


def window_costs(views: Views, window: Window, columns: int) -> WriteCosts:
    """Return what writes the costs of a window, for at most so many columns at a time."""
    rows = empty_cost_rows(columns, window)

    def write(band: tuple[int, int], top: int, bottom: int, costs: UInt8) -> None:
        write_costs(views, window, band, top, bottom, rows, costs)

    return write


@kernel
def write_costs(
    views: Views,
    window: Window,
    columns: tuple[int, int],
    top: int,
    bottom: int,
    rows: CostRows,
    costs: UInt8,
) -> None:
    """Write the costs of some columns of rows ``top`` to ``bottom - 1``, to uint8 (N, P, C).

    ``costs`` is a ring: row ``y`` goes to ``costs[y % N]``.
    """
    if top >= bottom:
        return
    block, ndisp = rows.sums.shape[0], costs.shape[1]
    for first in range(0, ndisp, block):
        rows.rows[:] = np.uint8(0)
        rows.sums[:] = np.uint16(0)
        end = min(first + block, ndisp)
        for y in range(top - window.rows_radius, bottom + window.rows_radius):
            # Until the window is full, costs are written that the next rows overwrite.
            middle = max(y - window.rows_radius, top) % costs.shape[0]
            _write_block(views, window, columns, first, end, y, rows, costs[middle])


@kernel
def _write_block(
    views: Views,
    window: Window,
    columns: tuple[int, int],
    first: int,
    end: int,
    y: int,
    rows: CostRows,
    costs: UInt8,
) -> None:
    """Move the window down to row ``y`` (clamped to the image), and write its costs (P, C).

    After ``2·rows_radius + 1`` calls for successive rows, they are those of the middle row.
    """
    height = 2 * window.rows_radius + 1
    oldest = rows.rows[(y + height * (window.rows_radius + 1)) % height]
    line = min(max(y, 0), views.grey.shape[0] - 1)
    left, right, start = views.left[line], views.right[line], columns[0]
    reach = columns[1] - start + 2 * window.radius
    # Candidate 0 of the first column.
    place = start + costs.shape[0] - 1
    _compare(left, right, start, place, reach, first, end, window.gradient_cap, rows.pixels)
    _slide_window(rows.pixels, window, oldest, rows.sums, first, end, costs)


@kernel
def _compare(
    left: UInt8,
    right: UInt8,
    start: int,
    place: int,
    reach: int,
    first: int,
    end: int,
    gradient_cap: int,
    pixels: UInt8,
) -> None:
    """Write the differences of gradients plus the differing bits of the census."""
    cap = splat(np.uint8(gradient_cap))
    for x in range(0, reach, LANES):
        here, there = start + x, place + x
        gradient, bits = load_row(left, 0, here), load_row(left, 1, here)
        bits_2, bits_3 = load_row(left, 2, here), load_row(left, 3, here)
        for k in range(first, end):
            other = load_row(right, 0, there - k)
            apart = smaller(absolute_difference(gradient, other), cap)
            one = differing_bits(bits, load_row(right, 1, there - k))
            two = differing_bits(bits_2, load_row(right, 2, there - k))
            three = differing_bits(bits_3, load_row(right, 3, there - k))
            store_row(pixels, k - first, x, apart + one + two + three)


@kernel
def _sum_across(pixels: UInt8, n: int, x: int, radius: int) -> Vector:
    total = load_row(pixels, n, x)
    for d in range(x + 1, x + 2 * radius + 1):
        total = total + load_row(pixels, n, d)
    return total


@kernel
def _sum_across_wide(pixels: UInt8, n: int, x: int, window: Window, sums: UInt16) -> Vector:
    """Return the same in uint16, shifted to fit into uint8."""
    total = widen(load_row(pixels, n, x), sums)
    for d in range(x + 1, x + 2 * window.radius + 1):
        total = total + widen(load_row(pixels, n, d), sums)
    return narrow(total >> splat(np.uint16(window.row_shift)))


@kernel
def _slide_window(
    pixels: UInt8, window: Window, oldest: UInt8, sums: UInt16, first: int, end: int, costs: UInt8
) -> None:
    """Replace the oldest row of a block's sums by the newest; write the scaled sums."""
    factor, shift = splat(np.uint16(window.factor)), splat(np.uint16(window.shift))
    for n in range(end - first):
        for x in range(0, costs.shape[1], LANES):
            if window.row_shift == 0:
                across = _sum_across(pixels, n, x, window.radius)
            else:
                across = _sum_across_wide(pixels, n, x, window, sums)
            out = load_row(oldest, n, x)
            store_row(oldest, n, x, across)
            total = load_row(sums, n, x) - widen(out, sums) + widen(across, sums)
            store_row(sums, n, x, total)
            store_row(costs, first + n, x, narrow(total * factor >> shift))


@kernel
def write_planes(grey: UInt8, place: int, first: int, end: int, planes: UInt8) -> None:
    """Write the gradients and the census of some rows, continued by those of the border pixels.

    Plane 0 is the gradient plus the cap. Bit ``n % 8`` of plane ``1 + n // 8`` is set where
    neighbour ``n`` (row by row, the middle left out) is darker than the pixel. Column 0 of the
    image goes to column ``place`` of the planes, (H, PLANES, R), or outside them.
    """
    height, width = grey.shape
    # Row y is at place y % N of the rows around, column x at radius + x.
    radius = CENSUS_RADIUS
    around = np.empty((2 * radius + 1, radius + width + radius + LANES), np.uint8)
    row = np.empty((PLANES, width + LANES), np.uint8)
    for y in range(first - 2 * radius, end):
        line = min(max(y + radius, 0), height - 1)
        continue_row(grey[line], radius, around[(y + radius) % around.shape[0]])
        if y >= first:
            _write_gradient(around, y, row[0, :width])
            _write_census(around, y, width, row)
            for n in range(row.shape[0]):
                continue_row(row[n, :width], place, planes[y, n])


@kernel
def _write_gradient(around: UInt8, y: int, gradient: UInt8) -> None:
    rows, radius, most = around.shape[0], CENSUS_RADIUS, np.int16(GRADIENT_CAP)
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
def _write_census(around: UInt8, y: int, width: int, planes: UInt8) -> None:
    rows, none, first = around.shape[0], splat(np.uint8(0)), splat(np.uint8(1))
    for x in range(0, width, LANES):
        middle = load_row(around, y % rows, CENSUS_RADIUS + x)
        n, bits, bit = 0, none, first
        for dy in range(-CENSUS_RADIUS, CENSUS_RADIUS + 1):
            line = (y + dy) % rows
            for dx in range(-CENSUS_RADIUS, CENSUS_RADIUS + 1):
                if dy != 0 or dx != 0:
                    neighbour = load_row(around, line, CENSUS_RADIUS + dx + x)
                    bits, bit = where_less(neighbour, middle, bits + bit, bits), bit + bit
                    n += 1
                    if n % 8 == 0:
                        store_row(planes, n // 8, x, bits)
                        bits, bit = none, first
