"""True poses that nobody measured: where data were missing, they are interpolated."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry.se3 import angle_rad, invert
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool
from recon.core.words import counted
from recon.evaluation.segments import Segments

_EVEN: Final = 0.02
"""A turn changes evenly from frame to frame if it does so less than this share of the median."""

_LEAST_CHANGES: Final = 5
"""Fewer even changes in a row may be chance."""

_LEAST_MEDIAN_RAD: Final = 5e-5
"""Where turns change less than this everywhere, the digits of the file decide: KITTI has six."""


def interpolated_poses(path: Trajectory) -> Bool:
    """Return bool (N,): poses along which the path turns at one rate, as it does nowhere else.

    A vehicle never does for more than a moment: its rates of turn change from frame to frame. A
    path that turns evenly for the most part has none, as rendered ones do.

    Args:
        path: The true path, at about equal times.
    """
    found = np.zeros(len(path), np.bool_)
    if len(path) < _LEAST_CHANGES + 2:
        return found
    step = invert(path.T_world_camera[:-1]) @ path.T_world_camera[1:]
    change = angle_rad(invert(step[:-1]) @ step[1:])
    typical = float(np.median(change))
    even = (change < _EVEN * typical) & (typical > _LEAST_MEDIAN_RAD)
    for first in np.flatnonzero(_runs(even)):
        found[first : first + _LEAST_CHANGES + 2] = True
    return found


def interpolation_warnings(truth: Trajectory, segments: Segments) -> list[str]:
    """Return what to know of relative errors: how many rest on poses that nobody measured."""
    found = interpolated_poses(truth)
    if not found.any():
        return []
    resting = int((found[segments.first] | found[segments.last]).sum())
    first, last = np.flatnonzero(found)[[0, -1]]
    which = f"{counted(int(found.sum()), 'true pose')} (between {first} and {last})"
    where = f"{resting} of {counted(len(segments.first), 'segment')} begin or end there"
    return [f"{which} turn evenly, as interpolated ones do: {where}"]


def _runs(even: Bool) -> Bool:
    """Return where so many even changes begin."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(even, _LEAST_CHANGES).all(axis=1))
