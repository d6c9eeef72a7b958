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

NODE_PX: Final = 4  # a plane is fitted in every fourth row and column
STEEPEST: Final = 1.5  # slope of a plane at most, disparities per pixel
_FITS: Final = 3  # each with the pixels that are near the one before
_LEAST_WEIGHT: Final = 3.0  # below it a fit says nothing of slopes
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
    for i in range(first, end):
        for j in range(nodes.shape[2]):
            y, x = NODE_PX * i, NODE_PX * j
            nodes[0, i, j], nodes[1, i, j], nodes[2, i, j] = values[y, x], 0.0, 0.0
            if np.isnan(values[y, x]):
                continue
            top, bottom = max(y - radius, y % stride), min(y + radius + 1, height)
            start, stop = max(x - radius, x % stride), min(x + radius + 1, width)
            value, across, down = float(values[y, x]), 0.0, 0.0
            limit = 2.0 * within_px
            for _ in range(_FITS):
                # Sums of the weights, of columns and rows, of what is left, and of their products.
                n, sx, sy, r, rx, ry = 1e-6, 0.0, 0.0, 0.0, 0.0, 0.0
                sxx, sxy, syy = pull, 0.0, pull
                for v in range(top, bottom, stride):
                    for u in range(start, stop, stride):
                        dx, dy = u - x, v - y
                        rest = values[v, u] - (value + across * dx + down * dy)
                        # Unknown values fail the comparison.
                        if not abs(rest) < limit:
                            continue
                        apart = 0
                        for c in range(3):
                            apart += abs(np.int64(guide[v, u, c]) - np.int64(guide[y, x, c]))
                        near = 1.0 - (rest / limit) * (rest / limit)
                        w = alike[apart] * weights[v, u] * near
                        n, sx, sy = n + w, sx + w * dx, sy + w * dy
                        sxx, sxy, syy = sxx + w * dx * dx, sxy + w * dx * dy, syy + w * dy * dy
                        r, rx, ry = r + w * rest, rx + w * rest * dx, ry + w * rest * dy
                if n < _LEAST_WEIGHT:
                    break
                more, a, b = least_squares(n, sx, sy, r, rx, ry, sxx, sxy, syy)
                value, across, down, limit = value + more, across + a, down + b, within_px
            steep = max(abs(across), abs(down))
            if steep < STEEPEST and abs(value - values[y, x]) < limit:
                nodes[0, i, j], nodes[1, i, j], nodes[2, i, j] = value, across, down


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
    """Write the planes (3, W, K) that the pixels of row ``y`` may take, and their costs (W, K)."""
    height, width = sources.shape[2:]
    last, outside = np.float32(volume.shape[1] - 1), np.float32(changes.outside)
    minimum = np.float32(changes.minimum)
    for x in range(width):
        for k in range(table.shape[0]):
            source = sources[table[k, 0]]
            u = min(max(x + table[k, 1], 0), width - 1)
            v = min(max(y + table[k, 2], 0), height - 1)
            across, down = source[1, v, u], source[2, v, u]
            value = source[0, v, u] + across * np.float32(x - u) + down * np.float32(y - v)
            planes[0, x, k], planes[1, x, k], planes[2, x, k] = value, across, down
            place = value - minimum
            if place < 0 or place >= last or np.float32(x) < value:
                costs[x, k] = outside
            else:
                whole = np.int64(place)
                part = place - np.float32(whole)
                low, high = volume[y, whole, x], volume[y, whole + 1, x]
                costs[x, k] = np.float32(low) + part * (np.float32(high) - np.float32(low))


@kernel(inline="always")
def _advance(
    before: Float32,
    planes_before: Float32,
    x_before: int,
    planes: Float32,
    costs: Float32,
    x: int,
    dx: np.float32,
    dy: np.float32,
    per_px: np.float32,
    most: np.float32,
    path: Float32,
) -> None:
    """Write the costs (K) of a path at a pixel, from those at the pixel before it."""
    count, half = path.size, np.float32(0.5) * per_px
    value, across, down = planes[0, x], planes[1, x], planes[2, x]
    low = before[0]
    for i in range(1, count):
        low = min(low, before[i])
    ceiling = low + most
    for j in range(count):
        path[j] = ceiling
    for i in range(count):
        start = planes_before[0, x_before, i]
        here = start + planes_before[1, x_before, i] * dx + planes_before[2, x_before, i] * dy
        cost = before[i]
        for j in range(count):
            there = value[j] - across[j] * dx - down[j] * dy
            new = cost + half * (abs(here - value[j]) + abs(start - there))
            path[j] = new if new < path[j] else path[j]
    for j in range(count):
        path[j] += costs[x, j] - low


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
    rows. Paths come from the row above (below, if ``upwards``) and from the left (right).
    """
    height, width, count = sums.shape
    rows = np.empty((2, 3, width, count), np.float32)
    ends = np.empty((2, 3, width, count), np.float32)
    costs = np.empty((width, count), np.float32)
    beside = np.empty((2, count), np.float32)
    per_px, step = np.float32(changes.per_px), -1 if upwards else 1
    for n in range(height):
        y = height - 1 - n if upwards else n
        previous, planes = rows[1 - n % 2], rows[n % 2]
        above, paths = ends[1 - n % 2], ends[n % 2]
        _write_candidates(sources, table, volume, changes, y, planes, costs)
        for x in range(width):
            sums[y, x] = np.float32(0)
            for way in range(3):
                dx = way - 1
                u, path = x - dx, paths[way, x]
                if n == 0 or u < 0 or u >= width:
                    path[:] = costs[x]
                else:
                    most = _most(grey[y, x], grey[y - step, u], changes)
                    a, b = np.float32(dx), np.float32(step)
                    _advance(above[way, u], previous, u, planes, costs, x, a, b, per_px, most, path)
                # Straight paths count twice, as in `recon.stereo.kernels.paths`.
                weight = np.float32(2 if dx == 0 else 1)
                for j in range(count):
                    sums[y, x, j] += weight * path[j]
        for m in range(width):
            x = width - 1 - m if upwards else m
            here, last = beside[m % 2], beside[1 - m % 2]
            if m == 0:
                here[:] = costs[x]
            else:
                u = x - step
                most = _most(grey[y, x], grey[y, u], changes)
                a, b = np.float32(step), np.float32(0)
                _advance(last, planes, u, planes, costs, x, a, b, per_px, most, here)
            for j in range(count):
                sums[y, x, j] += np.float32(4) * here[j]


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
