"""Costs of all candidates of a row: gradients and census over a window, in uint8.

The costs of single pixels are kept for as many rows as the window is high, so that each is
computed once. As in `recon.kernels.sad`, the right view is mirrored and every intermediate cast
back; arrays are indexed whole, because a slice costs more than the 128 candidates behind it.

The twin in plain numpy is `recon.kernels.semi_global_reference.path_costs_reference`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.census import PLANES

LANES: Final = 64
"""Candidates are padded to a multiple of this: the bytes of a vector register."""


class Views(NamedTuple):
    """What is compared.

    Attributes:
        grey: uint8 (H, W), the left picture.
        left: uint8 (H, W), its gradients.
        right: uint8 (H, W + P - 1), those of the right picture, from `mirror_views`.
        left_census: uint8 (B, H, W), from `census_planes`.
        right_census: uint8 (B, H, W + P - 1), mirrored.
    """

    grey: NDArray[np.uint8]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    left_census: NDArray[np.uint8]
    right_census: NDArray[np.uint8]


class Window(NamedTuple):
    """What a cost sums up.

    Attributes:
        radius: Half width of the window, pixels: it is ``2·radius + 1`` wide.
        rows_radius: Half height of the window, pixels.
        gradient_cap: Largest difference of gradients that counts.
        factor: 65536 × path cost per window sum.
        top: Cost of the candidates that only pad, not below any other; at most 255.
    """

    radius: int
    rows_radius: int
    gradient_cap: int
    factor: int
    top: int


class CostRows(NamedTuple):
    """Room for the rows around the present one.

    Attributes:
        pixels: uint8 (2·rows_radius + 2, W, P), costs of single pixels, and one row of room.
        columns: uint16 (W, P), their sums over the rows of the window.
        sums: uint16 (1, P), the sums over the window at one pixel.
    """

    pixels: NDArray[np.uint8]
    columns: NDArray[np.uint16]
    sums: NDArray[np.uint16]


def padded_candidates(ndisp: int) -> int:
    """Number of candidates with the padding."""
    return -(-ndisp // LANES) * LANES


def mirror_view(right: NDArray[np.uint8], ndisp: int, minimum: int) -> NDArray[np.uint8]:
    """A right view (…, H, W) from right to left, its borders repeated: (…, H, W + P - 1).

    Column ``j`` is right column ``W - 1 - minimum - j``, clamped to the picture.
    """
    width = right.shape[-1]
    places = np.arange(width + padded_candidates(ndisp) - 1)
    columns = np.clip(width - 1 - minimum - places, 0, width - 1)
    return np.ascontiguousarray(right[..., columns])


def empty_cost_rows(width: int, candidates: int, window: Window) -> CostRows:
    """Room for `next_cost_row`, as before the first row."""
    return CostRows(
        np.zeros((2 * window.rows_radius + 2, width, candidates), np.uint8),
        np.zeros((width, candidates), np.uint16),
        np.zeros((1, candidates), np.uint16),
    )


@njit(cache=True, nogil=True)
def enter_row(views: Views, window: Window, y: int, rows: CostRows) -> None:
    """Take row ``y`` (clamped to the picture) into the sums, and the oldest row out."""
    height = 2 * window.rows_radius + 1
    oldest = rows.pixels[(y + height * (window.rows_radius + 1)) % height]
    fresh = rows.pixels[height]
    line = min(max(y, 0), views.grey.shape[0] - 1)
    _compare_gradients(views.left[line], views.right[line], window.gradient_cap, fresh)
    for plane in range(0, len(views.left_census), PLANES):
        left = views.left_census[plane : plane + PLANES, line]
        _add_bits(left, views.right_census[plane : plane + PLANES, line], fresh)
    _exchange(rows.columns, fresh, oldest)
    oldest[:] = fresh


@njit(cache=True, nogil=True)
def _compare_gradients(
    left: NDArray[np.uint8], right: NDArray[np.uint8], gradient_cap: int, pixels: NDArray[np.uint8]
) -> None:
    """Write how far the gradients of a row are apart."""
    width, candidates = pixels.shape
    cap = np.uint8(gradient_cap)
    for x in range(width):
        a, start = left[x], width - 1 - x
        others = right[start : start + candidates]
        for k in range(candidates):
            b = others[k]
            pixels[x, k] = min(np.uint8(max(a, b) - min(a, b)), cap)


@njit(cache=True, nogil=True)
def _add_bits(left: NDArray[np.uint8], right: NDArray[np.uint8], pixels: NDArray[np.uint8]) -> None:
    """Add the number of bits of three planes that differ: full adders make two planes of them."""
    width, candidates = pixels.shape
    for x in range(width):
        first, end = width - 1 - x, width - 1 - x + candidates
        a, b, c = left[0, x], left[1, x], left[2, x]
        right_a, right_b, right_c = right[0, first:end], right[1, first:end], right[2, first:end]
        for k in range(candidates):
            p, q, r = np.uint8(a ^ right_a[k]), np.uint8(b ^ right_b[k]), np.uint8(c ^ right_c[k])
            either = np.uint8(p ^ q)
            ones, twos = np.uint8(either ^ r), np.uint8(np.uint8(p & q) | np.uint8(either & r))
            bits = np.uint8(_count_bits(ones) + np.uint8(_count_bits(twos) << np.uint8(1)))
            pixels[x, k] = np.uint8(pixels[x, k] + bits)


@njit(cache=True, nogil=True)
def _count_bits(bits: np.uint8) -> np.uint8:
    """Number of bits that are set, counted in pairs, then in fours, then in all."""
    pairs, fours, all_bits = np.uint8(0x55), np.uint8(0x33), np.uint8(0x0F)
    bits = np.uint8(bits - np.uint8(np.uint8(bits >> np.uint8(1)) & pairs))
    upper = np.uint8(np.uint8(bits >> np.uint8(2)) & fours)
    bits = np.uint8(np.uint8(bits & fours) + upper)
    count: np.uint8 = np.uint8(np.uint8(bits + np.uint8(bits >> np.uint8(4))) & all_bits)
    return count


@njit(cache=True, nogil=True)
def _exchange(
    columns: NDArray[np.uint16], come: NDArray[np.uint8], gone: NDArray[np.uint8]
) -> None:
    """Take one row of costs out of the column sums and add another."""
    for x in range(columns.shape[0]):
        for k in range(columns.shape[1]):
            rest = np.uint16(columns[x, k] - np.uint16(gone[x, k]))
            columns[x, k] = np.uint16(rest + np.uint16(come[x, k]))


@njit(cache=True, nogil=True)
def write_costs(
    rows: CostRows, window: Window, ndisp: int, y: int, costs: NDArray[np.uint8]
) -> None:
    """Write row ``y`` of ``costs`` (rows, W, P): the scaled window sums, the padding at the top."""
    columns, sums, radius = rows.columns, rows.sums, window.radius
    last = columns.shape[0] - 1
    sums[:] = np.uint16(0)
    for x in range(-radius - 1, radius):
        column = min(max(x, 0), last)
        for k in range(sums.shape[1]):
            sums[0, k] = np.uint16(sums[0, k] + columns[column, k])
    factor = np.uint32(window.factor)
    for x in range(last + 1):
        come, gone = min(x + radius, last), max(x - radius - 1, 0)
        for k in range(sums.shape[1]):
            rest = np.uint16(sums[0, k] - columns[gone, k])
            sums[0, k] = np.uint16(rest + columns[come, k])
        for k in range(sums.shape[1]):
            scaled = np.uint32(np.uint32(sums[0, k]) * factor)
            costs[y, x, k] = np.uint8(scaled >> np.uint32(16))
        for k in range(ndisp, sums.shape[1]):
            costs[y, x, k] = np.uint8(window.top)
