"""Views that repeat another: the same pose of the board, captured again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from recon.core.values.arrays import Float64
from recon.rig.calibrate.bundle import Sighting, View

# A view repeats another if the corners moved by less than this share of the board's own size (rms
# distance of its corners from their mean, in the image). A hand that holds a board still moves it
# by that much (8 mm on a board of 9 by 6 squares of 25 mm); it is a roll of 6 degrees, or a tenth
# of the distance.
_STILL: Final = 0.1


def group_views(views: Sequence[View]) -> list[list[View]]:
    """Group the views by pose of the board: those of one group show the board where it was.

    Errors of corners on a still board are mostly the same in every image (flatness, lens, blur), so
    a repeated view is hardly a new measurement, and it never adds a pose.

    Args:
        views: The views, in any order.

    Returns:
        The groups in order of their first view. The first of each group represents it: the one
        that is nearest to the others.
    """
    groups: list[list[View]] = []
    for view in views:
        same = next((group for group in groups if _moved(group[0], view) < _STILL), None)
        if same is None:
            groups.append([view])
        else:
            same.append(view)
    return [_middle_first(group) for group in groups]


def _moved(first: View, second: View) -> float:
    """How far the corners moved between two views, relative to the board; the larger of both."""
    return max(_shift(*both) for both in zip(first.seen, second.seen, strict=True))


def _shift(first: Sighting, second: Sighting) -> float:
    a, b = first.pixels, second.pixels
    if not np.array_equal(first.numbers, second.numbers):  # a board that is seen in part
        _, here, there = np.intersect1d(first.numbers, second.numbers, return_indices=True)
        if 2 * len(here) < max(len(a), len(b)):
            return np.inf
        a, b = a[here], b[there]
    # A chessboard turned by 180 degrees looks the same, and its corners may begin at either end.
    return min(_rms(a - b), _rms(a - b[::-1])) / _rms(a - a.mean(axis=0))


def _rms(apart: Float64) -> float:
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def _middle_first(group: list[View]) -> list[View]:
    """The group with the view first whose largest distance to a few of the others is smallest."""
    if len(group) < 3:
        return group
    some = group[:: max(1, len(group) // 8)]
    middle = int(np.argmin([max(_moved(view, other) for other in some) for view in group]))
    return [group[middle], *group[:middle], *group[middle + 1 :]]
