"""Costs of all candidates of a row: gradients and census over a window, in uint8.

One row is an array (candidates, W): the pixels of a candidate lie side by side, in the left view
as in the right, so that vector registers are filled along the row and need no padding but at its
end. The sums over a window's width are kept for as many rows as the window is high. Every
intermediate is cast back to its width, and where a row starts at a variable column it is sliced
first (an index that might be negative is looked at for every pixel), or the loops lose their
vector instructions.

The twin in plain numpy is `recon.kernels.semi_global_reference.path_costs_reference`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.census import PLANES, count_bits

LANES: Final = 64
"""Columns are padded to a multiple of this: the bytes of a vector register."""

BLOCK: Final = 16
"""Candidates whose rows are kept at a time."""

TOGETHER: Final = 4
"""Candidates are padded to a multiple of this: so many are done in one loop."""


class Views(NamedTuple):
    """What is compared.

    Attributes:
        grey: uint8 (H, W), the left picture.
        left: uint8 (H, 1 + B, R), its gradients and census, from `left_planes`.
        right: uint8 (H, 1 + B, R + P - 1), those of the right picture, from `right_planes`.
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
        top: Cost of the candidates that only pad, not below any other; at most 253.
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
        pixels: uint8 (R + LANES), costs of single pixels of one candidate.
        wide: uint16 (C), sums over the window's width, before they lose bits.
        across: uint8 (C), the same afterwards.
        rows: uint8 (2·rows_radius + 1, BLOCK, C), the same for the rows of the window.
        sums: uint16 (BLOCK, C), their sums.
    """

    pixels: NDArray[np.uint8]
    wide: NDArray[np.uint16]
    across: NDArray[np.uint8]
    rows: NDArray[np.uint8]
    sums: NDArray[np.uint16]


def padded(number: int, multiple: int = LANES) -> int:
    """The next multiple."""
    return -(-number // multiple) * multiple


def aligned(shape: tuple[int, ...], kind: type[np.uint8 | np.uint16] = np.uint8) -> NDArray[Any]:
    """Zeros that start where a vector register's load crosses no cache line."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    room = np.zeros(size + LANES, np.uint8)
    start = -room.ctypes.data % LANES
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


def left_planes(planes: Sequence[NDArray[np.uint8]], radius: int) -> NDArray[np.uint8]:
    """Planes (H, W) with their borders repeated: (H, B, R), from column ``-radius`` on."""
    width = planes[0].shape[1]
    return _placed(planes, padded(width + 2 * radius), radius)


def right_planes(
    planes: Sequence[NDArray[np.uint8]], radius: int, ndisp: int, minimum: int
) -> NDArray[np.uint8]:
    """Planes (H, W) of the right view for all candidates: (H, B, R + P - 1).

    What column ``x`` of `left_planes` is compared with as candidate ``k`` stands at
    ``x - k + P - 1``; where the right picture ends, its borders are repeated.
    """
    width, candidates = planes[0].shape[1], padded(ndisp, TOGETHER)
    size = padded(width + 2 * radius) + candidates - 1
    return _placed(planes, size, candidates - 1 + radius + minimum)


def _placed(planes: Sequence[NDArray[np.uint8]], size: int, start: int) -> NDArray[np.uint8]:
    """Rows of that size with the planes from ``start`` on, which may be outside."""
    height, width = planes[0].shape
    placed = np.empty((height, len(planes), size), np.uint8)
    first, end = min(max(start, 0), size), min(max(start + width, 0), size)
    for n, plane in enumerate(planes):
        placed[:, n, :first] = plane[:, :1]
        placed[:, n, first:end] = plane[:, first - start : end - start]
        placed[:, n, end:] = plane[:, -1:]
    return placed


def empty_cost_rows(width: int, window: Window) -> CostRows:
    """Room for `write_costs`."""
    columns = padded(width)
    return CostRows(
        aligned((padded(width + 2 * window.radius) + LANES,)),
        aligned((columns,), np.uint16),
        aligned((columns,)),
        aligned((2 * window.rows_radius + 1, BLOCK, columns)),
        aligned((BLOCK, columns), np.uint16),
    )


@njit(cache=True, nogil=True)
def write_costs(
    views: Views,
    window: Window,
    ndisp: int,
    top: int,
    bottom: int,
    rows: CostRows,
    costs: NDArray[np.uint8],
) -> None:
    """Write the costs (N, P, C) of the rows from ``top`` until before ``bottom``.

    Row ``y`` goes to place ``y % N``. A block of candidates is done at a time, so that the rows of
    a window stay in the cache.
    """
    if top >= bottom:
        return
    block = rows.sums.shape[0]
    for first in range(0, ndisp, block):
        rows.rows[:] = np.uint8(0)
        rows.sums[:] = np.uint16(0)
        end = min(first + block, ndisp)
        for y in range(top - window.rows_radius, bottom + window.rows_radius):
            # The first rows are written over.
            middle = max(y - window.rows_radius, top) % costs.shape[0]
            _write_block(views, window, first, end, y, rows, costs[middle])
    for y in range(top, bottom):
        costs[y % costs.shape[0], ndisp:] = np.uint8(window.top)


@njit(cache=True, nogil=True)
def _write_block(
    views: Views,
    window: Window,
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
    left, right = views.left[line], views.right[line]
    for k in range(first, end):
        start = costs.shape[0] - 1 - k
        _compare_gradients(left, right, start, window.gradient_cap, rows.pixels)
        for plane in range(1, left.shape[0], PLANES):
            _add_bits(left, right, plane, start, rows.pixels)
        if window.row_shift == 0:
            _sum_across(rows.pixels, window.radius, rows.across)
        else:
            _sum_far_across(rows.pixels, window, rows.wide, rows.across)
        _exchange(rows.across, oldest[k - first], window, rows.sums[k - first], costs[k])


@njit(cache=True, nogil=True)
def _compare_gradients(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    start: int,
    gradient_cap: int,
    pixels: NDArray[np.uint8],
) -> None:
    """Write how far the gradients of a row are apart."""
    cap, others = np.uint8(gradient_cap), right[0, start:]
    for x in range(left.shape[1]):
        a, b = left[0, x], others[x]
        pixels[x] = min(np.uint8(max(a, b) - min(a, b)), cap)


@njit(cache=True, nogil=True)
def _add_bits(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    plane: int,
    start: int,
    pixels: NDArray[np.uint8],
) -> None:
    """Add the number of bits of three planes that differ."""
    first, second, third = (
        right[plane, start:],
        right[plane + 1, start:],
        right[plane + 2, start:],
    )
    for x in range(left.shape[1]):
        a = count_bits(np.uint8(left[plane, x] ^ first[x]))
        b = count_bits(np.uint8(left[plane + 1, x] ^ second[x]))
        c = count_bits(np.uint8(left[plane + 2, x] ^ third[x]))
        pixels[x] = np.uint8(np.uint8(pixels[x] + a) + np.uint8(b + c))


@njit(cache=True, nogil=True)
def _sum_across(pixels: NDArray[np.uint8], radius: int, across: NDArray[np.uint8]) -> None:
    """Sum the costs over the window's width."""
    if radius == 2:
        for x in range(across.size):
            outer, inner = (
                np.uint8(pixels[x] + pixels[x + 4]),
                np.uint8(pixels[x + 1] + pixels[x + 3]),
            )
            across[x] = np.uint8(np.uint8(outer + inner) + pixels[x + 2])
        return
    for x in range(across.size):
        across[x] = pixels[x + radius]
    for d in range(radius):
        end = 2 * radius - d
        for x in range(across.size):
            across[x] = np.uint8(across[x] + np.uint8(pixels[x + d] + pixels[x + end]))


@njit(cache=True, nogil=True)
def _sum_far_across(
    pixels: NDArray[np.uint8],
    window: Window,
    wide: NDArray[np.uint16],
    across: NDArray[np.uint8],
) -> None:
    """The same for windows whose sums need their lowest bits cut."""
    wide[:] = np.uint16(0)
    for d in range(2 * window.radius + 1):
        for x in range(wide.size):
            wide[x] = np.uint16(wide[x] + np.uint16(pixels[x + d]))
    shift = np.uint16(window.row_shift)
    for x in range(wide.size):
        across[x] = np.uint8(np.uint16(wide[x] >> shift))


@njit(cache=True, nogil=True)
def _exchange(
    across: NDArray[np.uint8],
    oldest: NDArray[np.uint8],
    window: Window,
    sums: NDArray[np.uint16],
    costs: NDArray[np.uint8],
) -> None:
    """Take the oldest row out of the sums of a candidate and another in; write the scaled sums."""
    factor, shift = np.uint16(window.factor), np.uint16(window.shift)
    for x in range(across.size):
        rest = np.uint16(sums[x] - np.uint16(oldest[x]))
        total = np.uint16(rest + np.uint16(across[x]))
        sums[x] = total
        oldest[x] = across[x]
        costs[x] = np.uint8(np.uint16(np.uint16(total * factor) >> shift))
