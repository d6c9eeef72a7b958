"""What a search finds: the best candidate of each pixel, in the left view and in the right.

Both views are found from the same costs, so a left-right check needs no second search.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import UInt8, UInt16, kernel

NO_COST: Final = 65535  # of a candidate that does not exist; real costs stay below it


class Minima(NamedTuple):
    """What a search finds."""

    winner: UInt16  # (H, W), best candidate of each pixel of the left view; ndisp = none
    #: (4, H, W), costs of the best, of the ones before and after it, and of the best that is
    #: at least two candidates away; `NO_COST` = does not exist.
    costs: UInt16
    right_winner: UInt16  # (H, W), best candidate of each pixel of the right view; ndisp = none


def empty_minima(height: int, width: int) -> Minima:
    """Return arrays for a search to write to."""
    # One block, so that the system uses large pages: faulting in small ones outlasts a search.
    block = np.empty((6, height, width), np.uint16)
    return Minima(winner=block[0], costs=block[1:5], right_winner=block[5])


@kernel
def write_right_winners(ndisp: int, minimum: int, y: int, minima: Minima) -> None:
    """Match each pixel of row ``y`` of the right view to the left pixel that chose it best.

    The left pixel of the least cost gets it, of equal ones the leftmost. The check is weaker than
    with a search of the right view among all costs, but takes a hundredth of the time.
    """
    best = np.full(minima.winner.shape[1], NO_COST, np.uint16)
    winners, costs, chosen = minima.winner[y], minima.costs[0, y], minima.right_winner[y]
    chosen[:] = ndisp
    for x in range(best.size):
        k = np.int64(winners[x])
        if k < ndisp:
            # Unsigned: an index that cannot be negative needs no check.
            right = np.uint64(x - minimum - k)
            if costs[x] < best[right]:
                best[right], chosen[right] = costs[x], k


@kernel
def continue_row(row: UInt8, at: int, longer: UInt8) -> None:
    """Copy a row into a longer one, from place ``at`` on, also outside; its ends go on beyond."""
    start = min(max(at, 0), longer.size)
    end = min(max(at + row.size, 0), longer.size)
    longer[:start] = row[0]
    longer[end:] = row[-1]
    shown, inside = row[start - at :], longer[start:end]
    for c in range(inside.size):
        inside[c] = shown[c]
