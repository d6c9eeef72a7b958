"""A search among planes: each pixel takes one of its own or of pixels around it.

What windows cannot tell, on surfaces that are plain or slanted, neighbours that are matched can:
their planes, continued to a pixel, are candidates of the same standing as its own. The choice is
semi-global: the cost of a plane is that of its disparity in the volume of matching costs, and a
change of plane along a path costs as much as the two surfaces are apart where they meet, up to a
limit. A plane that goes on costs nothing, however slanted it is.

Ref: M. Bleyer, C. Rhemann, C. Rother, "PatchMatch stereo: stereo matching with slanted support
windows", BMVC 2011 (planes that spread); T. Taniai, Y. Matsushita, Y. Sato, T. Naemura, "Continuous
3D label stereo matching using local expansion moves", PAMI 40, 2018 (the distance of two planes);
H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30, 2008.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, Int32, UInt8, kernel
from recon.stereo.kernels.simd.vectors import (
    WIDE,
    absolute_difference,
    broadcast_smallest,
    load_row,
    smaller,
    splat,
    splat_at,
    store_row,
)

NODE_PX: Final = 4  # a plane is fitted in every fourth row and column
STEEPEST: Final = 1.5  # slope of a plane at most, disparities per pixel
_FITS: Final = 3  # each with the pixels that are near the one before
_LEAST_WEIGHT: Final = 3.0  # below it a fit says nothing of slopes
_COLUMNS: Final = 32  # of candidates that are written together
_PULL: Final = 1e-3  # of slopes towards zero, where all points lie in a line


class Changes(NamedTuple):
    """What a change of plane costs along a path, in the unit of the volume."""

    per_px: float  # for each pixel of disparity that the planes are apart
    most: float  # at most
    most_at_edge: float  # at most, where the image has an edge
    edge: int  # difference of grey levels from which there is an edge
    outside: float  # cost of a plane that leaves the range or the right image
    minimum: int  # disparity of candidate 0, pixels


@kernel(inline="always")
def least_squares(
    n: float,
    sx: float,
    sy: float,
    r: float,
    rx: float,
    ry: float,
    sxx: float,
    sxy: float,
    syy: float,
) -> tuple[float, float, float]:
    """Return the plane nearest to points: its value at the origin and its slopes.

    Given are sums over the points: of their weights, of columns and rows, of values, of values by
    columns and rows, and of the products of columns and rows, all by weight.
    """
    mx, my = sx / n, sy / n
    a, b, d = sxx - mx * sx, sxy - mx * sy, syy - my * sy
    det = max(a * d - b * b, 1e-12)
    p, q = rx - mx * r, ry - my * r
    across, down = (p * d - q * b) / det, (q * a - p * b) / det
    return r / n - across * mx - down * my, across, down


@kernel
def fit_nodes(
    values: Float32,
    weights: Float32,
    guide: UInt8,
    alike: Float32,
    radius: int,
    stride: int,
    within_px: float,
    first: int,
    end: int,
    nodes: Float32,
) -> None:
    """Fit a plane to the disparities around each node of some rows of nodes.

    ``values`` and ``weights`` are float32 (H, W), NaN = unknown; ``guide`` is uint8 (H, W, 3), and
    ``alike`` is the weight of each difference of its colours, summed over the channels, float32
    (766,). Disparities farther than ``within_px`` from the plane do not count. Node ``(i, j)``,
    at pixel ``(NODE_PX·i, NODE_PX·j)``, gets its value and slopes: float32 (3, h, w); where its own
    disparity is unknown, NaN and level.
    """
    (height, width), pull = values.shape, float(_PULL * radius * radius)
    most = (2 * radius // stride + 1) ** 2 + WIDE
    points, sums = np.empty((4, most), np.float32), np.empty((9, WIDE), np.float32)
    for i in range(first, end):
        for j in range(nodes.shape[2]):
            y, x = NODE_PX * i, NODE_PX * j
            nodes[0, i, j], nodes[1, i, j], nodes[2, i, j] = values[y, x], 0.0, 0.0
            if np.isnan(values[y, x]):
                continue
            top, bottom = max(y - radius, y % stride), min(y + radius + 1, height)
            start, stop = max(x - radius, x % stride), min(x + radius + 1, width)
            count = 0
            for v in range(top, bottom, stride):
                for u in range(start, stop, stride):
                    if not np.isnan(values[v, u]):
                        apart = 0
                        for c in range(3):
                            apart += abs(np.int64(guide[v, u, c]) - np.int64(guide[y, x, c]))
                        points[0, count], points[1, count] = u - x, v - y
                        points[2, count] = values[v, u] - values[y, x]
                        points[3, count] = alike[apart] * weights[v, u]
                        count += 1
            points[:, count : count + WIDE] = np.float32(0)
            value, across, down = 0.0, 0.0, 0.0
            limit = 2.0 * within_px
            for _ in range(_FITS):
                _add_moments(points, count, value, across, down, limit, sums)
                n, sx, sy = 1e-6 + sums[0].sum(), sums[1].sum(), sums[2].sum()
                if n < _LEAST_WEIGHT:
                    break
                r, rx, ry = sums[3].sum(), sums[4].sum(), sums[5].sum()
                sxx, sxy, syy = pull + sums[6].sum(), sums[7].sum(), pull + sums[8].sum()
                more, a, b = least_squares(n, sx, sy, r, rx, ry, sxx, sxy, syy)
                value, across, down, limit = value + more, across + a, down + b, within_px
            steep = max(abs(across), abs(down))
            if steep < STEEPEST and abs(value) < limit:
                nodes[0, i, j] = values[y, x] + value
                nodes[1, i, j], nodes[2, i, j] = across, down


@kernel
def _add_moments(
    points: Float32,
    count: int,
    value: float,
    across: float,
    down: float,
    limit: float,
    sums: Float32,
) -> None:
    """Add up the weights of points (4, N), lane by lane, by what `least_squares` wants: (9, WIDE).

    A point weighs the less, the farther it is from the plane, and beyond ``limit`` nothing.
    """
    start, slope = splat(np.float32(value)), splat(np.float32(across))
    fall, rate = splat(np.float32(down)), splat(np.float32(1 / limit**2))
    none, one = splat(np.float32(0)), splat(np.float32(1))
    n = sx = sy = r = rx = ry = sxx = sxy = syy = none
    for i in range(0, count, WIDE):
        dx, dy = load_row(points, 0, i), load_row(points, 1, i)
        rest = load_row(points, 2, i) - start - slope * dx - fall * dy
        w = load_row(points, 3, i) * (one - smaller(rest * rest * rate, one))
        wx, wy, left = w * dx, w * dy, w * rest
        n, sx, sy = n + w, sx + wx, sy + wy
        r, rx, ry = r + left, rx + left * dx, ry + left * dy
        sxx, sxy, syy = sxx + wx * dx, sxy + wx * dy, syy + wy * dy
    store_row(sums, 0, 0, n)
    store_row(sums, 1, 0, sx)
    store_row(sums, 2, 0, sy)
    store_row(sums, 3, 0, r)
    store_row(sums, 4, 0, rx)
    store_row(sums, 5, 0, ry)
    store_row(sums, 6, 0, sxx)
    store_row(sums, 7, 0, sxy)
    store_row(sums, 8, 0, syy)


@kernel
def spread_nodes(
    nodes: Float32, values: Float32, own: bool, first: int, end: int, planes: Float32
) -> None:
    """Give each pixel of some rows the plane of its nearest node, float32 (3, H, W).

    Its value is the node's plane there or, if ``own``, that of the pixel, with the node's slopes.
    A pixel without a value keeps the plane that it has.
    """
    width = values.shape[1]
    for y in range(first, end):
        i = min((y + NODE_PX // 2) // NODE_PX, nodes.shape[1] - 1)
        for x in range(width):
            j = min((x + NODE_PX // 2) // NODE_PX, nodes.shape[2] - 1)
            across, down = nodes[1, i, j], nodes[2, i, j]
            value = values[y, x]
            if not own:
                value = nodes[0, i, j] + across * (x - NODE_PX * j) + down * (y - NODE_PX * i)
            if not np.isnan(value):
                planes[0, y, x], planes[1, y, x], planes[2, y, x] = value, across, down


@kernel
def _write_candidates(
    sources: Float32,
    table: Int32,
    volume: UInt8,
    changes: Changes,
    y: int,
    planes: Float32,
    costs: Float32,
) -> None:
    """Write the planes (3, W, K) that the pixels of row ``y`` may take, and their costs (W, K).

    Planes are in the unit of costs: what half a pixel of disparity costs on the way to another.
    """
    height, width = sources.shape[2:]
    last, outside = np.float32(volume.shape[1] - 1), np.float32(changes.outside)
    minimum, half = np.float32(changes.minimum), np.float32(changes.per_px / 2)
    # What is written for some columns stays in the nearest cache until all planes are.
    for start in range(0, width, _COLUMNS):
        for k in range(table.shape[0]):
            v = min(max(y + table[k, 2], 0), height - 1)
            source, beside, drop = sources[table[k, 0]], table[k, 1], np.float32(y - v)
            values, across, down = source[0, v], source[1, v], source[2, v]
            for x in range(start, min(start + _COLUMNS, width)):
                u = min(max(x + beside, 0), width - 1)
                value = values[u] + across[u] * np.float32(x - u) + down[u] * drop
                planes[0, x, k], planes[1, x, k] = half * value, half * across[u]
                planes[2, x, k] = half * down[u]
                place = value - minimum
                if place < 0 or place >= last or np.float32(x) < value:
                    costs[x, k] = outside
                else:
                    whole = np.int64(place)
                    part = place - np.float32(whole)
                    low, high = volume[y, whole, x], volume[y, whole + 1, x]
                    costs[x, k] = np.float32(low) + part * (np.float32(high) - np.float32(low))


@kernel
def _follow(
    before: Float32,
    planes_before: Float32,
    grey_before: UInt8,
    planes: Float32,
    grey: UInt8,
    costs: Float32,
    dx: int,
    dy: int,
    changes: Changes,
    moved: Float32,
    path: Float32,
) -> None:
    """Write the costs (W, K) of a path at the pixels of a row, from those ``before``.

    The pixel before one is ``dx`` columns and ``dy`` rows back; where it is outside the image the
    path starts. ``moved`` is scratch (W, K).
    """
    width, count = path.shape
    across, down = splat(np.float32(dx)), splat(np.float32(dy))
    starts, slopes, falls = planes_before[0], planes_before[1], planes_before[2]
    values, slopes_here, falls_here = planes[0], planes[1], planes[2]
    for x in range(width):
        for k in range(0, count, WIDE):
            there = load_row(starts, x, k) + load_row(slopes, x, k) * across
            store_row(moved, x, k, there + load_row(falls, x, k) * down)
    for m in range(width):
        x = m if dx >= 0 else width - 1 - m
        u = x - dx
        if u < 0 or u >= width:
            path[x] = costs[x]
            continue
        low = load_row(before, u, 0)
        for k in range(WIDE, count, WIDE):
            low = smaller(low, load_row(before, u, k))
        low = broadcast_smallest(low)
        ceiling = low + splat(_most(grey[x], grey_before[u], changes))
        for k in range(0, count, WIDE):
            value = load_row(values, x, k)
            there = value - load_row(slopes_here, x, k) * across
            there = there - load_row(falls_here, x, k) * down
            # Two at a time: neither waits for the other.
            best = second = ceiling
            for i in range(0, count, 2):
                gap = absolute_difference(splat_at(moved, u, i), value)
                gap = gap + absolute_difference(splat_at(starts, u, i), there)
                best = smaller(best, gap + splat_at(before, u, i))
                gap = absolute_difference(splat_at(moved, u, i + 1), value)
                gap = gap + absolute_difference(splat_at(starts, u, i + 1), there)
                second = smaller(second, gap + splat_at(before, u, i + 1))
            best = smaller(best, second) + load_row(costs, x, k)
            store_row(path, x, k, best - low)


@kernel
def sweep(
    sources: Float32,
    table: Int32,
    volume: UInt8,
    grey: UInt8,
    changes: Changes,
    upwards: bool,
    sums: Float32,
) -> None:
    """Add up the costs of four paths at each pixel, to float32 (H, W, K).

    The candidates of a pixel are planes ``sources``, float32 (S, 3, H, W), each a value and two
    slopes: row ``k`` of ``table``, int32 (K, 3), is which of them and at what distance, columns and
    rows. K is a multiple of `WIDE`. Paths come from the row above (below, if ``upwards``) and from
    the left (right).
    """
    height, width, count = sums.shape
    rows = np.empty((2, 3, width, count), np.float32)
    ends = np.empty((2, 3, width, count), np.float32)
    scratch = np.empty((3, width, count), np.float32)
    costs, moved, beside = scratch[0], scratch[1], scratch[2]
    step, two, four = -1 if upwards else 1, np.float32(2), np.float32(4)
    for n in range(height):
        y = height - 1 - n if upwards else n
        previous, planes = rows[1 - n % 2], rows[n % 2]
        above, paths = ends[1 - n % 2], ends[n % 2]
        _write_candidates(sources, table, volume, changes, y, planes, costs)
        for way in range(3):
            if n == 0:
                paths[way] = costs
            else:
                _follow(
                    *(above[way], previous, grey[y - step], planes, grey[y], costs),
                    *(way - 1, step, changes, moved, paths[way]),
                )
        _follow(*(beside, planes, grey[y], planes, grey[y], costs, step, 0, changes, moved, beside))
        # Straight paths count twice, as in `recon.stereo.kernels.paths`.
        for x in range(width):
            for k in range(count):
                slanted = paths[0, x, k] + paths[2, x, k]
                sums[y, x, k] = slanted + two * paths[1, x, k] + four * beside[x, k]


@kernel(inline="always")
def _most(one: np.uint8, other: np.uint8, changes: Changes) -> np.float32:
    edge = abs(np.int64(one) - np.int64(other)) > changes.edge
    most: np.float32 = np.float32(changes.most_at_edge if edge else changes.most)
    return most


@kernel
def choose_planes(
    sums: Float32,
    more: Float32,
    sources: Float32,
    table: Int32,
    first: int,
    end: int,
    planes: Float32,
) -> None:
    """Give each pixel of some rows the candidate whose two sums are least."""
    height, width, count = sums.shape[0], sums.shape[1], sums.shape[2]
    for y in range(first, end):
        for x in range(width):
            best = 0
            for k in range(1, count):
                if sums[y, x, k] + more[y, x, k] < sums[y, x, best] + more[y, x, best]:
                    best = k
            source = sources[table[best, 0]]
            u = min(max(x + table[best, 1], 0), width - 1)
            v = min(max(y + table[best, 2], 0), height - 1)
            across, down = source[1, v, u], source[2, v, u]
            planes[1, y, x], planes[2, y, x] = across, down
            planes[0, y, x] = (
                source[0, v, u] + across * np.float32(x - u) + down * np.float32(y - v)
            )


@kernel
def mark_hidden(values: Float32, within_px: float, first: int, end: int, hidden: Bool) -> None:
    """Mark the pixels of some rows whose place in the right view shows what is nearer.

    That is a pixel whose disparity is larger by more than ``within_px``.
    """
    width = values.shape[1]
    nearest = np.empty(width, np.float32)
    for y in range(first, end):
        nearest[:] = np.float32(-np.inf)
        for x in range(width):
            there = np.int64(np.floor(np.float32(x) - values[y, x] + np.float32(0.5)))
            if 0 <= there < width:
                nearest[there] = max(nearest[there], values[y, x])
        for x in range(width):
            there = np.int64(np.floor(np.float32(x) - values[y, x] + np.float32(0.5)))
            inside = 0 <= there < width
            hidden[y, x] = inside and nearest[there] > values[y, x] + np.float32(within_px)
