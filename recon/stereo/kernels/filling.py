"""Evidence for planes where nothing was measured, planes of segments, votes beside steps.

A plane that goes on to where matches lie on it on all sides is what was seen, with a gap. One that
is supported along one edge is a guess: the sky beside a roof is no roof.

Of a segment the plane is taken that most of what was seen in it lies on.

Windows that see both sides of a step of depth are drawn to the side with more texture, which is
mostly the nearer one: its disparity reaches beyond its edge by half a window. What the image looks
like says which side a pixel is of.

Ref: M. Fischler and R. Bolles, "Random sample consensus", CACM 24, 1981; H. Tao, H. Sawhney,
R. Kumar, "A global matching framework for stereo computation", ICCV 2001 (planes of segments);
K.-J. Yoon, I. S. Kweon, "Adaptive support-weight approach for correspondence search", PAMI 28, 2006
(pixels of like colour are of one surface); Z. Ma et al., "Constant time weighted median filtering
for stereo matching and beyond", ICCV 2013 (as a vote on a disparity map).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, Float64, Int32, Int64, UInt8, UInt16, kernel
from recon.stereo.kernels.planes import STEEPEST, least_squares

#: Rows and columns to the next pixel, in the order of their angles.
STEPS: Final = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
DIRECTIONS: Final = len(STEPS)
NOWHERE: Final = 0  # distance to what there is not


@kernel
def find_nearest(known: Bool, direction: int, distances: UInt16) -> None:
    """Write how many steps it is to the next known pixel in a direction, uint16 (H, W).

    `NOWHERE` = none before the border. The pixel itself does not count.
    """
    height, width = known.shape
    down, right = STEPS[direction]
    for i in range(height):
        y = height - 1 - i if down > 0 else i
        for j in range(width):
            x = width - 1 - j if right > 0 else j
            v, u, steps = y + down, x + right, 0
            if 0 <= v < height and 0 <= u < width:
                before = np.int64(distances[v, u])
                steps = 1 if known[v, u] else before + min(before, 1)
            distances[y, x] = np.uint16(steps)


@kernel
def weigh_planes(
    values: Float32,
    distances: UInt16,
    planes: Float32,
    wanted: Bool,
    within_px: float,
    first: int,
    end: int,
    evidence: UInt8,
) -> None:
    """Count what speaks for and against the planes of the wanted pixels of some rows.

    In each direction the plane, float32 (3, H, W), is continued to the next known pixel
    (``distances``, uint16 (8, H, W), of `find_nearest`). It speaks for the plane if its value lies
    within ``within_px`` of it, and against it if it lies behind it; what lies before it may hide
    it. ``evidence``, uint8 (3, H, W), gets how many speak for it, how many against it, and how many
    neighbouring directions at most do not speak for it.
    """
    width = values.shape[1]
    for y in range(first, end):
        for x in range(width):
            evidence[0, y, x] = evidence[1, y, x] = 0
            evidence[2, y, x] = DIRECTIONS
            if not wanted[y, x] or np.isnan(planes[0, y, x]):
                continue
            speaks, against, agree = 0, 0, 0
            for k in range(DIRECTIONS):
                steps = np.int64(distances[k, y, x])
                if steps == NOWHERE:
                    continue
                dy, dx = steps * STEPS[k][0], steps * STEPS[k][1]
                there = planes[0, y, x] + planes[1, y, x] * dx + planes[2, y, x] * dy
                rest = values[y + dy, x + dx] - there
                if abs(rest) <= within_px:
                    speaks, agree = speaks + 1, agree | (1 << k)
                else:
                    against += rest < 0
            gap, longest = 0, 0
            for k in range(2 * DIRECTIONS):
                gap = 0 if agree >> (k % DIRECTIONS) & 1 else gap + 1
                longest = max(longest, gap)
            evidence[0, y, x], evidence[1, y, x] = speaks, against
            evidence[2, y, x] = min(longest, DIRECTIONS)


_MOST: Final = 4096  # pixels of a segment that are fitted to, evenly spread
_JUDGES: Final = 512  # of them, those by which a plane through three is judged
_LEAST: Final = 30  # pixels that must lie on a plane
_LEAST_AREA: Final = 200.0  # of the parallelogram of three pixels
_FITS: Final = 3  # each to the pixels that are near the one before


@kernel
def sort_by_label(labels: Int32, starts: Int64, order: Int64) -> None:
    """Write the pixels (N,) of each label (N,), one label after the other, in their order.

    ``starts``, int64 (L + 1,), is where those of each label begin.
    """
    place = starts.copy()
    for pixel in range(labels.size):
        label = labels[pixel]
        order[place[label]] = pixel
        place[label] += 1


@kernel
def fit_segments(
    values: Float32,
    weights: Float32,
    order: Int64,
    starts: Int64,
    wanted: Int64,
    draws: Float64,
    within_px: float,
    first: int,
    end: int,
    planes: Float32,
    ratios: Float32,
) -> None:
    """Give the pixels of some of the segments ``wanted`` their plane, float32 (3, H, W).

    ``shares``, float32 (H, W), gets which fraction of all pixels of the segment lie on it.

    ``values`` and ``weights`` are float32 (H, W), NaN = unknown; pixels that are farther than
    ``within_px`` from a plane do not count. ``draws``, float64 (T, 3), from 0 to 1, says through
    which pixels of a segment planes are tried. Pixels of a segment without a plane keep what they
    have. ``order`` and ``starts`` are as in `sort_by_label`.
    """
    width = values.shape[1]
    points = np.empty((4, _MOST))  # columns, rows, values, weights
    for number in range(first, end):
        begin, stop = starts[wanted[number]], starts[wanted[number] + 1]
        known = 0
        for i in range(begin, stop):
            known += not np.isnan(values[order[i] // width, order[i] % width])
        stride, count, seen = 1 + known // _MOST, 0, 0
        for i in range(begin, stop):
            y, x = order[i] // width, order[i] % width
            if np.isnan(values[y, x]):
                continue
            if seen % stride == 0:
                points[0, count], points[1, count] = x, y
                points[2, count], points[3, count] = values[y, x], weights[y, x]
                count += 1
            seen += 1
        if count < _LEAST:
            continue
        plane, left = _best_plane(points[:, :count], draws, within_px), count
        for _ in range(_FITS):
            if left >= _LEAST:
                left, plane = _refined(points[:, :count], plane, within_px)
        value, across, down = plane
        if left < _LEAST or max(abs(across), abs(down)) > STEEPEST:
            continue
        ratio = np.float32(known * left / (count * (stop - begin)))
        for i in range(begin, stop):
            y, x = order[i] // width, order[i] % width
            planes[0, y, x] = value + across * x + down * y
            planes[1, y, x], planes[2, y, x] = across, down
            ratios[y, x] = ratio


@kernel
def _best_plane(points: Float64, draws: Float64, within_px: float) -> tuple[float, float, float]:
    """Return the plane through three of the points (4, N) that most of them support."""
    x, y, d, w = points
    count = x.size
    stride = 1 + count // _JUDGES
    best, value, across, down = 0.0, d[0], 0.0, 0.0
    for t in range(draws.shape[0]):
        i, j, k = int(draws[t, 0] * count), int(draws[t, 1] * count), int(draws[t, 2] * count)
        jx, jy, jd = x[j] - x[i], y[j] - y[i], d[j] - d[i]
        kx, ky, kd = x[k] - x[i], y[k] - y[i], d[k] - d[i]
        area = jx * ky - jy * kx
        if abs(area) < _LEAST_AREA:
            continue
        a, b = (jd * ky - kd * jy) / area, (jx * kd - kx * jd) / area
        if max(abs(a), abs(b)) > STEEPEST:
            continue
        v, support = d[i] - a * x[i] - b * y[i], 0.0
        for n in range(0, count, stride):
            rest = (d[n] - v - a * x[n] - b * y[n]) / within_px
            support += w[n] * max(0.0, 1.0 - rest * rest)
        if support > best:
            best, value, across, down = support, v, a, b
    return value, across, down


@kernel
def _refined(
    points: Float64, plane: tuple[float, float, float], within_px: float
) -> tuple[int, tuple[float, float, float]]:
    """Return how many of the points (4, N) lie on a plane, and the plane nearest to these."""
    (x, y, d, w), (value, across, down) = points, plane
    # About the middle of the points, for the sake of precision.
    mx, my, near = x.mean(), y.mean(), 0
    n, sx, sy, r, rx, ry, sxx, sxy, syy = 1e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-3, 0.0, 1e-3
    for i in range(x.size):
        rest = d[i] - value - across * x[i] - down * y[i]
        if abs(rest) >= within_px:
            continue
        near += 1
        dx, dy = x[i] - mx, y[i] - my
        n, sx, sy = n + w[i], sx + w[i] * dx, sy + w[i] * dy
        sxx, sxy, syy = sxx + w[i] * dx * dx, sxy + w[i] * dx * dy, syy + w[i] * dy * dy
        r, rx, ry = r + w[i] * rest, rx + w[i] * rest * dx, ry + w[i] * rest * dy
    more, a, b = least_squares(n, sx, sy, r, rx, ry, sxx, sxy, syy)
    return near, (value + more - a * mx - b * my, across + a, down + b)


class Vote(NamedTuple):
    """Who votes on the disparity of a pixel beside a step, and for what."""

    radius: int  # half the square of those who vote, pixels
    stride: int  # every so manieth row and column of it
    same_px: float  # a disparity of the same surface differs by less beside the pixel
    slope: float  # and by so much more with each pixel of distance


@kernel
def mark_steps(values: Float32, reach: int, step_px: float, marked: UInt8) -> None:
    """Mark the pixels within ``reach`` of a step between two neighbours in a row.

    Neighbours are known disparities with no more than ``3·reach`` columns between them: beside a
    step, one side is hidden. Other pixels keep their mark.
    """
    height, width = values.shape
    for y in range(height):
        last = -1
        for x in range(width):
            if np.isnan(values[y, x]):
                continue
            near = last >= 0 and x - last <= 3 * reach
            if near and abs(values[y, x] - values[y, last]) > step_px:
                marked[y, max(last - reach + 1, 0) : min(x + reach, width)] = 1
            last = x


@kernel
def take_votes(
    values: Float32,
    grey: UInt8,
    alike: Float32,
    marked: UInt8,
    vote: Vote,
    first: int,
    end: int,
    own: Float32,
) -> None:
    """Write which fraction of the votes is for the disparity of each marked pixel of some rows.

    The pixels around it vote by how alike they are: ``alike``, float32 (256,), is the weight of a
    difference of grey levels. ``own``, float32 (H, W), is negative where a nearer or a farther
    surface has more votes than its own, and 1 where nothing is marked or known.
    """
    (height, width), reach = values.shape, vote.radius // vote.stride * vote.stride
    for y in range(first, end):
        for x in range(width):
            own[y, x] = 1
            if not marked[y, x] or np.isnan(values[y, x]):
                continue
            value, level = values[y, x], np.int64(grey[y, x])
            nearer, same, farther = np.float32(0), np.float32(0), np.float32(0)
            for dy in range(-reach, reach + 1, vote.stride):
                for dx in range(-reach, reach + 1, vote.stride):
                    v, u = y + dy, x + dx
                    if v < 0 or u < 0 or v >= height or u >= width or np.isnan(values[v, u]):
                        continue
                    weight = alike[abs(np.int64(grey[v, u]) - level)]
                    limit = vote.same_px + vote.slope * max(abs(dy), abs(dx))
                    apart = values[v, u] - value
                    if apart > limit:
                        nearer += weight
                    elif apart < -limit:
                        farther += weight
                    else:
                        same += weight
            ratio = same / (nearer + same + farther)
            own[y, x] = ratio if same >= max(nearer, farther) else ratio - np.float32(1)
