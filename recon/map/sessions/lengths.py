"""Whether two drives measure the same lengths, as rigs do whose baselines are right."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Final

import numpy as np

from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import apply
from recon.core.values import Trajectory
from recon.map.store.map_file import MapFile
from recon.places.loop import Loop

_FEWEST: Final = 5
"""Links from which a scale is estimated, besides six parameters of the place."""
_LARGEST: Final = 0.02
"""Difference that drift explains: twice what odometry is expected to be off by in each drive."""
_SIGMAS: Final = 4.0


def doubts_of_lengths(map_: MapFile) -> list[str]:
    """Return a line for each two drives, one of which finds the same street longer."""
    kept = sorted((link for link in map_.links if link.kept), key=lambda link: link.sessions)
    lines = []
    for (one, other), links in groupby(kept, key=lambda link: link.sessions):
        paths = (map_.session(one).odometry, map_.session(other).odometry)
        longer = times_as_long(*paths, [link.loop for link in links])
        if longer is not None and abs(longer[0] - 1.0) > max(_LARGEST, _SIGMAS * longer[1]):
            lines.append(
                f"between the places that both saw, session {one} is {longer[0]:.3f} times as long "
                f"as session {other}: the baseline of one rig is off, or a drive has drifted"
            )
    return lines


def times_as_long(
    one: Trajectory, other: Trajectory, links: Sequence[Loop]
) -> tuple[float, float] | None:
    """Return how many times as long one drive is as another, and the standard deviation of that.

    Args:
        one: Its path by odometry, in which links have their ``first``.
        other: That of the other drive, in which they have their ``last``.
        links: Places that both saw.

    Returns:
        None where there are too few links, or all are at one place.
    """
    if len(links) < _FEWEST:
        return None
    others_m = other.positions_m[[link.last for link in links]]
    ones_m = np.array(
        [(one.T_world_camera[link.first] @ link.T_first_last)[:3, 3] for link in links]
    )
    spread_m = float(np.sqrt(np.sum((others_m - others_m.mean(axis=0)) ** 2)))
    if spread_m < 1.0:
        return None
    fitted = fit_points(others_m, ones_m, scaled=True)
    left_m = apply(fitted.T_to_from, fitted.scale * others_m) - ones_m
    freedom = 3 * len(links) - 7
    sigma_m = float(np.sqrt(np.sum(left_m**2) / freedom))
    return fitted.scale, sigma_m / spread_m
