"""What speaks for a plane where nothing was measured: what was, in eight directions around.

A plane that goes on to where matches lie on it on all sides is what was seen, with a gap. One that
is supported along one edge is a guess: the sky beside a roof is no roof.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, UInt8, UInt16, kernel

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
