"""Costs of all candidates of a row: gradients and census over a window, in uint8.

One row is an array (candidates, W): the pixels of a candidate lie side by side, in the left view
as in the right, so that vector registers are filled along the row and need no padding but at its
end. The sums over a window's width are kept for as many rows as the window is high.

The twin in plain numpy is `recon.kernels.semi_global_reference.path_costs_reference`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.census import PLANES, Look, write_planes
from recon.kernels.lanes import (
    LANES,
    Lanes,
    differing_bits,
    distance,
    fit,
    least,
    load_row,
    narrow,
    splat,
    store_row,
)

ALIGNMENT: Final = 64
"""Bytes of a cache line."""

BLOCK: Final = 16
"""Candidates whose rows are kept at a time."""


class Views(NamedTuple):
    """What is compared.

    Attributes:
        grey: uint8 (H, W), the left picture.
        left: uint8 (H, 1 + B, R), its gradients and census, from column ``-radius`` on.
        right: uint8 (H, 1 + B, R + P - 1), those of the right picture; `places_of` says where.
    """

    grey: NDArray[np.uint8]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]


class Window(NamedTuple):
    """What a cost sums up: `scaled_window` makes one.

    Attributes:
        radius: Half width of the window, pixels: it is ``2·radius + 1`` wide.
        rows_radius: Half height of the window, pixels.
        gradient_cap: Largest difference of gradients that counts.
        row_shift: Bits that the sum over the window's width loses, to fit into uint8.
        factor: The sum over its height, times this, fits into uint16 ...
        shift: ... and loses so many bits.
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
    """Room for the rows around the present one.

    Attributes:
        pixels: uint8 (BLOCK, R + LANES), costs of single pixels.
        rows: uint8 (2·rows_radius + 1, BLOCK, C), sums over the window's width, for its rows.
        sums: uint16 (BLOCK, C), their sums.
    """

    pixels: NDArray[np.uint8]
    rows: NDArray[np.uint8]
    sums: NDArray[np.uint16]


def padded(number: int, multiple: int = LANES) -> int:
    """The next multiple."""
    return -(-number // multiple) * multiple


def aligned(shape: tuple[int, ...], kind: type[np.uint8 | np.uint16] = np.uint8) -> NDArray[Any]:
    """Zeros that start where a vector register's load crosses no cache line."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    room = np.zeros(size + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    return room[start : start + size].view(kind).reshape(shape)


def scaled_window(
    radius: int, rows_radius: int, gradient_cap: int, largest: int, levels: float
) -> Window:
    """The window whose costs are about ``levels`` times the mean cost of a pixel.

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
    # The largest scale that 16 bits hold.
    shift = max(0, int(np.log2(65535 / top)))
    factor = max(1, int(top * 2**shift / most))
    return Window(
        radius, rows_radius, gradient_cap, row_shift, factor, shift, most * factor >> shift
    )


def empty_planes(
    height: int, width: int, planes: int, radius: int, ndisp: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Room for what is compared, ``planes`` of each picture: `Views.left` and `Views.right`."""
    # What is read of a row, wherever a band of the picture begins.
    reach = padded(width + 2 * radius) + LANES
    left, right = (height, planes, reach), (height, planes, reach + ndisp - 1)
    return np.empty(left, np.uint8), np.empty(right, np.uint8)


def write_views(
    right: NDArray[np.uint8], look: Look, places: tuple[int, int], rows: range, views: Views
) -> None:
    """Write what is compared of some rows.

    Args:
        right: uint8 (H, W), the right picture; that on the left is in ``views``.
        look: What is looked at.
        places: Where column 0 of each picture stands, from `places_of`.
        rows: The rows.
        views: Written.
    """
    write_planes(views.grey, look, places[0], rows.start, rows.stop, views.left)
    write_planes(right, look, places[1], rows.start, rows.stop, views.right)


def places_of(window: Window, ndisp: int, minimum: int) -> tuple[int, int]:
    """Where column 0 of the left and the right picture stand in their planes.

    What column ``x`` of the left ones is compared with as candidate ``k`` stands in the right ones
    at ``x - k + P - 1``.
    """
    return window.radius, ndisp - 1 + window.radius + minimum


def empty_cost_rows(columns: int, window: Window) -> CostRows:
    """Room for `write_costs`; columns is a multiple of `LANES`."""
    return CostRows(
        aligned((BLOCK, padded(columns + 2 * window.radius) + LANES)),
        aligned((2 * window.rows_radius + 1, BLOCK, columns)),
        aligned((BLOCK, columns), np.uint16),
    )


@njit(cache=True, nogil=True)
def write_costs(
    views: Views,
    window: Window,
    columns: tuple[int, int],
    top: int,
    bottom: int,
    rows: CostRows,
    costs: NDArray[np.uint8],
) -> None:
    """Write the costs (N, P, C) of some columns of the rows from ``top`` until before ``bottom``.

    Row ``y`` goes to place ``y % N``. A block of candidates is done at a time, so that the rows of
    a window stay in the cache.
    """
    if top >= bottom:
        return
    block, ndisp = rows.sums.shape[0], costs.shape[1]
    for first in range(0, ndisp, block):
        rows.rows[:] = np.uint8(0)
        rows.sums[:] = np.uint16(0)
        end = min(first + block, ndisp)
        for y in range(top - window.rows_radius, bottom + window.rows_radius):
            # The first rows are written over.
            middle = max(y - window.rows_radius, top) % costs.shape[0]
            _write_block(views, window, columns, first, end, y, rows, costs[middle])


@njit(cache=True, nogil=True)
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
    """Take row ``y`` (clamped to the picture) into the sums, the oldest out, and write costs.

    After ``2·rows_radius + 1`` calls for successive rows, the costs (P, C) are those of the row in
    their middle.
    """
    height = 2 * window.rows_radius + 1
    oldest = rows.rows[(y + height * (window.rows_radius + 1)) % height]
    line = min(max(y, 0), views.grey.shape[0] - 1)
    left, right, start = views.left[line], views.right[line], columns[0]
    reach = columns[1] - start + 2 * window.radius
    # Where candidate 0 stands in the right row.
    place = start + costs.shape[0] - 1
    _compare(left, right, start, place, reach, first, end, window.gradient_cap, rows.pixels)
    for plane in range(1 + PLANES, left.shape[0], PLANES):
        _add_bits(left, right, plane, start, place, reach, first, end, rows.pixels)
    _exchange(rows.pixels, window, oldest, rows.sums, first, end, costs)


@njit(cache=True, nogil=True)
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
    """Write how far gradients are apart, plus the bits of the first three planes that differ."""
    cap = splat(np.uint8(gradient_cap))
    for x in range(0, reach, LANES):
        here, there = start + x, place + x
        gradient, bits = load_row(left, 0, here), load_row(left, 1, here)
        bits_2, bits_3 = load_row(left, 2, here), load_row(left, 3, here)
        for k in range(first, end):
            other = load_row(right, 0, there - k)
            apart = least(distance(gradient, other), cap)
            one = differing_bits(bits, load_row(right, 1, there - k))
            two = differing_bits(bits_2, load_row(right, 2, there - k))
            three = differing_bits(bits_3, load_row(right, 3, there - k))
            store_row(pixels, k - first, x, apart + one + two + three)


@njit(cache=True, nogil=True)
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
    """Add the bits of three more planes that differ."""
    for x in range(0, reach, LANES):
        for k in range(first, end):
            cost, there = load_row(pixels, k - first, x), place + x - k
            for n in range(plane, plane + PLANES):
                bits = differing_bits(load_row(left, n, start + x), load_row(right, n, there))
                cost = cost + bits
            store_row(pixels, k - first, x, cost)


@njit(cache=True, nogil=True)
def _sum_across(pixels: NDArray[np.uint8], n: int, x: int, radius: int) -> Lanes:
    """Sum the costs over the window's width."""
    total = load_row(pixels, n, x)
    for d in range(x + 1, x + 2 * radius + 1):
        total = total + load_row(pixels, n, d)
    return total


@njit(cache=True, nogil=True)
def _sum_far_across(
    pixels: NDArray[np.uint8], n: int, x: int, window: Window, sums: NDArray[np.uint16]
) -> Lanes:
    """The same for windows whose sums need their lowest bits cut."""
    total = fit(load_row(pixels, n, x), sums)
    for d in range(x + 1, x + 2 * window.radius + 1):
        total = total + fit(load_row(pixels, n, d), sums)
    return narrow(total >> splat(np.uint16(window.row_shift)))


@njit(cache=True, nogil=True)
def _exchange(
    pixels: NDArray[np.uint8],
    window: Window,
    oldest: NDArray[np.uint8],
    sums: NDArray[np.uint16],
    first: int,
    end: int,
    costs: NDArray[np.uint8],
) -> None:
    """Take the oldest row out of the sums of a block and another in; write the scaled sums."""
    factor, shift = splat(np.uint16(window.factor)), splat(np.uint16(window.shift))
    for n in range(end - first):
        for x in range(0, costs.shape[1], LANES):
            if window.row_shift == 0:
                across = _sum_across(pixels, n, x, window.radius)
            else:
                across = _sum_far_across(pixels, n, x, window, sums)
            out = load_row(oldest, n, x)
            store_row(oldest, n, x, across)
            total = load_row(sums, n, x) - fit(out, sums) + fit(across, sums)
            store_row(sums, n, x, total)
            store_row(costs, first + n, x, narrow(total * factor >> shift))
