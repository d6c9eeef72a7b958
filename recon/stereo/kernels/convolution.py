"""A small network of convolutions in 16 bits: descriptions of pixels by what is around them.

A row of features is an array (channels / 2, W) of pairs of channels, two int16 in an int32, since
processors multiply and add in pairs. Vector registers are filled along the row, and the sums of
`SUMS` channels for two vectors of pixels stay in them. Layers take turns row by row, so that of
each no more than three rows are kept, in the cache. How unlike two descriptions are is added to
matching costs.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Float32, Int32, Int64, UInt8, kernel
from recon.stereo.kernels.simd.vectors import (
    SUMS,
    WIDE,
    add_products,
    add_shifted,
    load,
    load_row,
    no_sums,
    store_sums,
)

SIDE: Final = 3  # of the square that a convolution is over, or 1
STEP: Final = 2 * WIDE  # columns that are done at a time
GROUP: Final = SUMS  # channels that are made together
UNIT: Final = 1 << 14  # that descriptions have the length of
_BLOCK: Final = 2 * STEP  # columns whose features stay in the nearest cache for all sums


class Layer(NamedTuple):
    """A convolution of C channels, to O channels."""

    weights: Int32  # (O / GROUP, C / 2 · squares, GROUP), pairs of channels
    scale: Float32  # (O,), that sums are multiplied by
    bias: Float32  # (O,), added then
    slope: float  # that what is negative is multiplied by, at last


@kernel
def convolve_rows(image: Int32, layers: tuple[Layer, ...], first: int, end: int, to: Int32) -> None:
    """Write rows ``first`` to ``end - 1`` of what layers make of an image, int32 (N, O / 2, W).

    ``image`` is int32 (H, 1, W); the square of all layers for row ``y`` and column ``x`` begins
    there. The last `STEP` columns of the result mean nothing. All layers but the last, which is
    over single pixels, are over squares.
    """
    width, count, pairs = image.shape[2], len(layers) - 1, layers[0].bias.size // 2
    rings, sums = np.zeros((count, SIDE, pairs, width), np.int32), np.zeros((64, width), np.int32)
    # Where in its source a row finds what its weights belong to, by its place in the ring.
    of_image, of_ring = (
        _places(1, width, 0)[: SIDE * SIDE],
        np.empty((SIDE, SIDE * SIDE * pairs), np.int64),
    )
    for turn in range(SIDE):
        of_ring[turn] = _places(pairs, width, turn)
    for t in range(end - first + (SIDE - 1) * (count - 1)):
        for n in range(count):
            y = t - (SIDE - 1) * n
            if y < 0:
                break
            if n == 0:
                source, start, places = image.reshape(-1), (first + y) * width, of_image
            else:
                source, start, places = rings[n - 1].reshape(-1), 0, of_ring[y % SIDE]
            _convolve(source, start, places, layers[n], sums, rings[n, y % SIDE])
        else:
            ring = rings[count - 1].reshape(-1)
            start = y % SIDE * pairs * width
            _convolve(ring, start, width * np.arange(pairs), layers[count], sums, to[first + y])


@kernel
def _places(pairs: int, width: int, turn: int) -> Int64:
    """Return where in a ring of rows the weights of a square belong, whose top row is ``turn``."""
    places = np.empty(pairs * SIDE * SIDE, np.int64)
    for n in range(places.size):
        c, v, u = n // (SIDE * SIDE), n // SIDE % SIDE, n % SIDE
        places[n] = ((turn + v) % SIDE * pairs + c) * width + u
    return places


@kernel
def _convolve(
    source: Int32, start: int, places: Int64, layer: Layer, sums: Int32, to: Int32
) -> None:
    """Write a row of a layer, (O / 2, W)."""
    width = to.shape[1]
    for left in range(0, width - STEP, _BLOCK):
        for group in range(layer.weights.shape[0]):
            weights = layer.weights[group]
            for x in range(left, min(left + _BLOCK, width - STEP), STEP):
                one = two = no_sums()
                for n in range(places.size):
                    at = start + places[n] + x
                    one = add_products(one, load(source, at), weights, n, 0)
                    two = add_products(two, load(source, at + WIDE), weights, n, 0)
                store_sums(sums, group * SUMS, x, one)
                store_sums(sums, group * SUMS, x + WIDE, two)
    slope = np.float32(layer.slope)
    for c in range(to.shape[0]):
        row, low, high = to[c], sums[2 * c], sums[2 * c + 1]
        a, b = layer.scale[2 * c], layer.scale[2 * c + 1]
        d, e = layer.bias[2 * c], layer.bias[2 * c + 1]
        for x in range(row.size):
            row[x] = _pair(
                _bent(np.float32(low[x]) * a + d, slope), _bent(np.float32(high[x]) * b + e, slope)
            )


@kernel(inline="always")
def _bent(value: np.float32, slope: np.float32) -> np.float32:
    value = value if value > 0 else value * slope
    most = np.float32(32767)
    value = value if value < most else most
    return value if value > -most else -most


@kernel
def unite(features: Int32, half: Int32, quarter: Int32, first: int, end: int) -> None:
    """Add to some rows of features those of half and quarter size, and make their length `UNIT`.

    All are int32 (N, C / 2, W), pairs of int16. Row and column 1 of the smaller ones are the first
    of the others, and they are interpolated between the middles of their pixels. The last `STEP`
    columns mean nothing.
    """
    pairs, width = features.shape[1], features.shape[2] - STEP
    sums, squares = np.empty((2 * pairs, width), np.float32), np.empty(width, np.float32)
    halves = np.empty(half.shape[2], np.float32)
    quarters = np.empty(quarter.shape[2], np.float32)
    for y in range(first, end):
        squares[:] = np.float32(1)
        for n in range(2 * pairs):
            row = sums[n]
            _row_of(features, y, y, np.float32(0), n, row)
            _row_of(half, *_around(y, 2), n, halves)
            _row_of(quarter, *_around(y, 4), n, quarters)
            _add_enlarged(halves, quarters, row)
            for x in range(width):
                squares[x] += row[x] * row[x]
        for x in range(width):
            squares[x] = np.float32(UNIT) / np.sqrt(squares[x])
        for c in range(pairs):
            low, high, row = sums[2 * c], sums[2 * c + 1], features[y, c]
            for x in range(width):
                row[x] = _pair(low[x] * squares[x], high[x] * squares[x])


@kernel(inline="always")
def _around(y: int, factor: int) -> tuple[int, int, np.float32]:
    """Return the rows of a smaller image around a row, and how far it is from the upper one."""
    place = (y + 0.5) / factor + 0.5
    return int(place), int(place) + 1, np.float32(place - int(place))


@kernel
def _row_of(pairs: Int32, top: int, bottom: int, down: np.float32, n: int, row: Float32) -> None:
    """Write channel ``n`` between two rows."""
    upper, lower = pairs[top, n // 2], pairs[bottom, n // 2]
    up = np.int32(16 if n % 2 == 0 else 0)
    for x in range(row.size):
        one = np.float32(np.int32(upper[x] << up) >> np.int32(16))
        other = np.float32(np.int32(lower[x] << up) >> np.int32(16))
        row[x] = one + down * (other - one)


@kernel
def _add_enlarged(half: Float32, quarter: Float32, row: Float32) -> None:
    near, far = np.float32(0.75), np.float32(0.25)
    a, b, c, d = np.float32(0.375), np.float32(0.625), np.float32(0.125), np.float32(0.875)
    for m in range(row.size // 4):
        x, n = 4 * m, 2 * m
        one, two, three = quarter[m], quarter[m + 1], quarter[m + 2]
        row[x] += a * one + b * two + far * half[n] + near * half[n + 1]
        row[x + 1] += c * one + d * two + near * half[n + 1] + far * half[n + 2]
        row[x + 2] += d * two + c * three + far * half[n + 1] + near * half[n + 2]
        row[x + 3] += b * two + a * three + near * half[n + 2] + far * half[n + 3]


@kernel(inline="always")
def _pair(low: np.float32, high: np.float32) -> np.int32:
    """Return two numbers, rounded to int16, in an int32."""
    lower = np.int32(np.int32(np.rint(low)) & np.int32(0xFFFF))
    pair: np.int32 = lower | np.int32(np.int32(np.rint(high)) << np.int32(16))
    return pair


TILE: Final = 64  # columns that are done at a time


class Blend(NamedTuple):
    """How learned costs are added to those that are there."""

    learned: float  # cost of features that are orthogonal
    largest: float  # largest learned cost
    top: float  # largest sum


@kernel
def add_dissimilarity(
    left: Int32,
    right: Int32,
    width: int,
    minimum: int,
    blend: Blend,
    first: int,
    end: int,
    costs: UInt8,
) -> None:
    """Add to the costs of rows ``first`` to ``end - 1`` one minus the product of the features.

    ``left`` and ``right`` are int32 (N, C / 2, at least W), pairs of int16, of length `UNIT`, in
    the left and the right view; ``costs`` is uint8 (N, P, at least W). Beyond the right image its
    border pixel is repeated, as it is in the windows.
    """
    pairs, ndisp = left.shape[1], costs.shape[1]
    sums = np.empty((SUMS, TILE), np.int32)
    before = np.int64(max(minimum + ndisp + SUMS, 1))
    after = np.int64(max(-minimum, 0)) + TILE
    ours = np.zeros((pairs, width + TILE), np.int32)
    others = np.empty((pairs, before + width + after), np.int32)
    learned, largest = np.float32(blend.learned), np.float32(blend.largest)
    fall, half, top = np.float32(-learned / UNIT**2), np.float32(0.5), np.float32(blend.top)
    for y in range(first, end):
        ours[:, :width] = left[y, :, :width]
        for c in range(pairs):
            others[c, :before] = right[y, c, 0]
            others[c, before : before + width] = right[y, c, :width]
            others[c, before + width :] = right[y, c, width - 1]
        for start in range(0, width, TILE):
            last = min(TILE, width - start)
            for k in range(0, ndisp, SUMS):
                for x in range(start, start + last, WIDE):
                    products, place = no_sums(), before + x - minimum - k
                    for c in range(pairs):
                        products = add_shifted(products, load_row(ours, c, x), others, c, place)
                    store_sums(sums, 0, x - start, products)
                for i in range(min(SUMS, ndisp - k)):
                    row, products_of = costs[y, k + i, start : start + last], sums[i]
                    for x in range(last):
                        unlike = min(learned + fall * np.float32(products_of[x]), largest)
                        row[x] = np.uint8(min(np.float32(row[x]) + unlike + half, top))
