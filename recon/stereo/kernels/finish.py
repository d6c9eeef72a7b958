"""What follows when disparities are found: what stands alone is marked, others averaged."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, Int32, UInt8, kernel


class _Runs(NamedTuple):
    """Connected pixels of a row: run ``n`` is ``starts[n]`` to ``ends[n] - 1``.

    There is memory for as many runs as pixels; pages that are never touched cost nothing.
    """

    starts: Int32  # (N,), indices into the flattened map
    ends: Int32  # (N,)
    parents: Int32  # (N,), an earlier run of the same region, or for the root itself
    sizes: Int32  # (N,), for a root, pixels of its region


class _Row(NamedTuple):
    runs: Int32  # (W,), the run of each pixel that has a value
    breaks: UInt8  # (W,), 1 where a pixel does not belong to the run of the one before


@kernel
def find_speckles(values: Float32, largest_step: float, smallest_size: int) -> Bool:
    """Return bool (H, W), the pixels of connected regions of fewer than ``smallest_size``.

    Neighbours (left, right, above, below) belong to one region when both have a value (not NaN) and
    the values differ by ``largest_step`` or less.

    Ref: union-find with path halving, R. Sedgewick, K. Wayne, "Algorithms", 4th ed., 1.5; runs as
    nodes, L. He et al., "A run-based two-scan labeling algorithm", IEEE Trans. Image Processing 17,
    2008.
    """
    height, width = values.shape
    block = np.empty((values.size, 4), np.int32)
    runs = _Runs(block[:, 0], block[:, 1], block[:, 2], block[:, 3])
    above = _Row(np.empty(width, np.int32), np.empty(width, np.uint8))
    here = _Row(np.empty(width, np.int32), np.empty(width, np.uint8))
    touches, joins = np.empty(width, np.uint8), np.empty(width, np.uint8)
    count, step = 0, np.float32(largest_step)
    for y in range(height):
        above, here = here, above
        count = _cut_row(values[y], y * width, step, runs, count, here)
        if y > 0:
            _mark_touching(values[y], values[y - 1], step, touches)
            _join_rows(touches, runs.parents, above, here, joins)
    small = np.zeros((height, width), np.bool_)
    _mark_small(runs, count, smallest_size, small.reshape(-1))
    return small


@kernel
def _cut_row(
    row: Float32, place: int, step: np.float32, runs: _Runs, count: int, here: _Row
) -> int:
    """Append the runs of a row to the ``count`` there are; return how many there are then."""
    breaks, width = here.breaks, row.size
    _mark_touching(row[1:], row, step, breaks[1:])
    for x in range(1, width):
        breaks[x] = np.uint8(1) - breaks[x]
    breaks[0], x = 1, 0
    while x < width:
        start = x
        x += 1
        while x < width and breaks[x] == 0:
            x += 1
        if not np.isnan(row[start]):
            here.runs[start:x] = count
            runs.starts[count], runs.ends[count] = place + start, place + x
            runs.parents[count], runs.sizes[count] = count, 0
            count += 1
    return count


@kernel
def _mark_touching(one: Float32, other: Float32, step: np.float32, marks: UInt8) -> None:
    """Mark the pixels whose values differ by a step or less. No comparison with NaN is true."""
    for x in range(one.size):
        marks[x] = np.uint8(1) if abs(one[x] - other[x]) <= step else np.uint8(0)


@kernel
def _join_rows(touches: UInt8, parents: Int32, above: _Row, here: _Row, joins: UInt8) -> None:
    """Join the runs of a row with those of the row above, where their pixels touch."""
    # Along two runs that touch, one join does: where either begins, or where they begin to touch.
    before, begins, begins_above = touches[:-1], here.breaks[1:], above.breaks[1:]
    joins[0], last = touches[0], joins[1:]
    for x in range(last.size):
        goes_on = before[x] & ~(begins[x] | begins_above[x])
        last[x] = touches[x + 1] & ~goes_on
    for x in range(joins.size):
        if joins[x] != 0:
            _join(parents, here.runs[x], above.runs[x])


@kernel
def _mark_small(runs: _Runs, count: int, smallest_size: int, small: Bool) -> None:
    parents = runs.parents
    for run in range(count):
        # A parent comes before its child: it points to its root already.
        parents[run] = parents[parents[run]]
        runs.sizes[parents[run]] += runs.ends[run] - runs.starts[run]
    for run in range(count):
        if runs.sizes[parents[run]] < smallest_size:
            small[runs.starts[run] : runs.ends[run]] = True


@kernel
def _join(parents: Int32, one: int, other: int) -> None:
    a, b = _root(parents, one), _root(parents, other)
    if a < b:
        parents[b] = a
    else:
        parents[a] = b


@kernel
def _root(parents: Int32, node: int) -> int:
    """Return the root of a node's region; every step halves the path for the next call."""
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


@kernel
def average_opposite(
    values: Float32, radius: int, largest_step: float, first: int, end: int, averages: Float32
) -> None:
    """Average each pixel of some rows with the pairs of opposite neighbours that are near it.

    A pair is a neighbour and its mirror image about the pixel; it counts where both are within
    ``radius`` columns and rows and within the image, have a value, and differ from the pixel's by
    ``largest_step`` or less. On a plane the mean of a pair is the pixel's own value, so slopes
    stay, even beside holes and steps. Only the fields of a chessboard that have the pixel's colour
    are used: the noise of neighbours is correlated, so the others would add little.
    """
    height, width = values.shape
    step = np.float32(largest_step)
    count = np.empty(width, np.float32)
    for y in range(first, end):
        row, total = values[y], averages[y]
        total[:] = row
        count[:] = np.float32(1)
        for dy in range(min(radius, y, height - 1 - y) + 1):
            before, after = values[y - dy], values[y + dy]
            for dx in range((dy - radius) % 2 - radius if dy else 2, radius + 1, 2):
                # The pixels whose two neighbours lie within the row.
                start, stop = min(abs(dx), width), max(width - abs(dx), 0)
                _add_pair(
                    before[start - dx :], after[start + dx :], row[start:stop], step,
                    total[start:stop], count[start:stop],
                )  # fmt: skip
        for x in range(width):
            total[x] /= count[x]


@kernel
def _add_pair(
    one: Float32, other: Float32, row: Float32, step: np.float32, total: Float32, count: Float32
) -> None:
    """Add one pair of neighbours of each pixel of a row. No comparison with NaN is true."""
    zero, two = np.float32(0), np.float32(2)
    for x in range(row.size):
        a, b, centre = one[x], other[x], row[x]
        near = (abs(a - centre) <= step) & (abs(b - centre) <= step)
        total[x] += a + b if near else zero
        count[x] += two if near else zero


@kernel
def count_supporters(padded: Float32, limits: Float32) -> UInt8:
    """Count the neighbours of each pixel whose values differ by no more than a limit.

    Args:
        padded: float32 (H + 2r, W + 2r), an image in a frame of r pixels; NaN is near nothing.
        limits: float32 (2r + 1, 2r + 1), the largest difference of each neighbour in the window.

    Returns:
        uint8 (H, W); a pixel itself counts, whatever it is.
    """
    side = len(limits)
    radius = side // 2
    height, width = padded.shape[0] - 2 * radius, padded.shape[1] - 2 * radius
    count = np.ones((height, width), np.uint8)
    for v in range(height):
        here = padded[v + radius, radius : radius + width]
        for dy in range(side):
            for dx in range(side):
                if dy == radius and dx == radius:
                    continue
                there, limit = padded[v + dy, dx : dx + width], limits[dy, dx]
                for u in range(width):
                    count[v, u] += np.uint8(abs(here[u] - there[u]) <= limit)
    return count
