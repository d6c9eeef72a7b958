"""Matching costs of all candidates of a row: gradients and census over a window, in uint8.

A row of costs is an array (candidates, W). The pixels of a candidate lie side by side, in the left
view as in the right, so vector registers are filled along the row and only its end needs padding.
Sums over the window's width are kept for as many rows as the window is high.

The reference implementation is in `tests/stereo/kernels/semi_global_reference.py`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel
from recon.stereo.kernels.census import PLANES, Descriptor, write_planes
from recon.stereo.kernels.simd import (
    LANES,
    Vector,
    absolute_difference,
    differing_bits,
    load_row,
    narrow,
    smaller,
    splat,
    store_row,
    widen,
)

ALIGNMENT: Final = 64
"""Bytes of a cache line."""

BLOCK: Final = 16
"""Candidates done at a time: their rows of the window stay in the cache."""


class Views(NamedTuple):
    """Both images, as the costs compare them.

    Attributes:
        grey: uint8 (H, W), the left image.
        left: uint8 (H, 1 + B, R), its planes: the gradient, and B planes of census bits. Columns
            are shifted by `column_offsets`.
        right: uint8 (H, 1 + B, R + P - 1), those of the right image.
    """

    grey: NDArray[np.uint8]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]


class Window(NamedTuple):
    """The window that costs are summed over, and how sums are scaled to uint8.

    The sum over the width is shifted right by ``row_shift``; the sum of those over the height is
    multiplied by ``factor`` and shifted right by ``shift``. `scaled_window` chooses the three.

    Attributes:
        radius: Half width of the window, pixels: it is ``2·radius + 1`` wide.
        rows_radius: Half height of the window, pixels.
        gradient_cap: Largest difference of gradients that counts.
        row_shift: Bits; the shifted sum over the width fits into uint8.
        factor: The sum over the height times this fits into uint16.
        shift: Bits.
        top: The largest cost; at most 253.
    """

    radius: int
    rows_radius: int
    gradient_cap: int
    row_shift: int
    factor: int
    shift: int
    top: int

    @property
    def levels(self) -> float:
        """Steps of a path cost for one step of a pixel's cost."""
        pixels = (2 * self.radius + 1) * (2 * self.rows_radius + 1)
        return pixels * self.factor * 2.0 ** -(self.row_shift + self.shift)


class CostRows(NamedTuple):
    """Scratch memory for the sums over a window of C columns.

    Attributes:
        pixels: uint8 (BLOCK, R + LANES), costs of single pixels.
        rows: uint8 (2·rows_radius + 1, BLOCK, C), a ring: sums over the width, of each row.
        sums: uint16 (BLOCK, C), sums of those over the height.
    """

    pixels: NDArray[np.uint8]
    rows: NDArray[np.uint8]
    sums: NDArray[np.uint16]


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

    Args:
        radius: As in `Window`.
        rows_radius: As in `Window`.
        gradient_cap: As in `Window`.
        largest: Largest cost of one pixel.
        levels: Steps of a path cost for one step of a pixel's cost.
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


def empty_planes(
    height: int, width: int, planes: int, radius: int, ndisp: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return memory for `Views.left` and `Views.right`, with so many planes each."""
    # A band may start at any column, and its last vector reads beyond its end.
    reach = padded(width + 2 * radius) + LANES
    left, right = (height, planes, reach), (height, planes, reach + ndisp - 1)
    return np.empty(left, np.uint8), np.empty(right, np.uint8)


def write_views(
    right: NDArray[np.uint8],
    descriptor: Descriptor,
    offsets: tuple[int, int],
    rows: range,
    views: Views,
) -> None:
    """Write the planes of some rows of both images.

    Args:
        right: uint8 (H, W), the right image; the left one is in ``views``.
        descriptor: How pixels are described.
        offsets: From `column_offsets`.
        rows: The rows.
        views: Written.
    """
    write_planes(views.grey, descriptor, offsets[0], rows.start, rows.stop, views.left)
    write_planes(right, descriptor, offsets[1], rows.start, rows.stop, views.right)


def column_offsets(window: Window, ndisp: int, minimum: int) -> tuple[int, int]:
    """Return column of the planes that holds column 0 of the image, of the left and the right one.

    Column ``x`` of the left planes is compared, as candidate ``k``, with column ``x - k + P - 1``
    of the right ones.
    """
    return window.radius, ndisp - 1 + window.radius + minimum


def empty_cost_rows(columns: int, window: Window) -> CostRows:
    """Return memory for `write_costs`; columns is a multiple of `LANES`."""
    return CostRows(
        aligned((BLOCK, padded(columns + 2 * window.radius) + LANES)),
        aligned((2 * window.rows_radius + 1, BLOCK, columns)),
        aligned((BLOCK, columns), np.uint16),
    )


@kernel
def write_costs(
    views: Views,
    window: Window,
    columns: tuple[int, int],
    top: int,
    bottom: int,
    rows: CostRows,
    costs: NDArray[np.uint8],
) -> None:
    """Write the costs of some columns of rows ``top`` to ``bottom - 1``.

    Args:
        views: The images.
        window: What a cost sums up.
        columns: First column and the one after the last.
        top: First row.
        bottom: The row after the last.
        rows: Memory to work in.
        costs: Written: uint8 (N, P, C), a ring; row ``y`` goes to ``costs[y % N]``.
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
    costs: NDArray[np.uint8],
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
    for plane in range(1 + PLANES, left.shape[0], PLANES):
        _add_bits(left, right, plane, start, place, reach, first, end, rows.pixels)
    _slide_window(rows.pixels, window, oldest, rows.sums, first, end, costs)


@kernel
def _compare(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    start: int,
    place: int,
    reach: int,
    first: int,
    end: int,
    gradient_cap: int,
    pixels: NDArray[np.uint8],
) -> None:
    """Write the differences of gradients plus the differing bits of the first census planes."""
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
def _add_bits(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    plane: int,
    start: int,
    place: int,
    reach: int,
    first: int,
    end: int,
    pixels: NDArray[np.uint8],
) -> None:
    """Add the differing bits of the next `PLANES` census planes."""
    for x in range(0, reach, LANES):
        for k in range(first, end):
            cost, there = load_row(pixels, k - first, x), place + x - k
            for n in range(plane, plane + PLANES):
                bits = differing_bits(load_row(left, n, start + x), load_row(right, n, there))
                cost = cost + bits
            store_row(pixels, k - first, x, cost)


@kernel
def _sum_across(pixels: NDArray[np.uint8], n: int, x: int, radius: int) -> Vector:
    """Sum the costs over the window's width; the sums fit into uint8."""
    total = load_row(pixels, n, x)
    for d in range(x + 1, x + 2 * radius + 1):
        total = total + load_row(pixels, n, d)
    return total


@kernel
def _sum_across_wide(
    pixels: NDArray[np.uint8], n: int, x: int, window: Window, sums: NDArray[np.uint16]
) -> Vector:
    """Return the same in uint16, shifted to fit into uint8."""
    total = widen(load_row(pixels, n, x), sums)
    for d in range(x + 1, x + 2 * window.radius + 1):
        total = total + widen(load_row(pixels, n, d), sums)
    return narrow(total >> splat(np.uint16(window.row_shift)))


@kernel
def _slide_window(
    pixels: NDArray[np.uint8],
    window: Window,
    oldest: NDArray[np.uint8],
    sums: NDArray[np.uint16],
    first: int,
    end: int,
    costs: NDArray[np.uint8],
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
