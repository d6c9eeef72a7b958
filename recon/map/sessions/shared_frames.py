"""Frames that two drives share: recordings that overlap, such as one that was cut in two.

A frame is known by its time and its rays. These are computed from its images alone, so those of the
same images are equal to the last bit, and those of others never are.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.map.store.map_file import MapFile
from recon.map.store.session import Session
from recon.places.loop import Loop

_INFORMATION: Final = 1e8
"""Of what is the same: 0.1 mm and 0.1 mrad, as no covariance may be zero."""


def shared_frames(one: Session, other: Session) -> NDArray[np.intp]:
    """Return int (K, 2), the frames that two drives of one map share, by number in either."""
    times_s, others_s = one.odometry.timestamps_s, other.odometry.timestamps_s
    _, firsts, lasts = np.intersect1d(times_s, others_s, return_indices=True)
    pairs = zip(firsts.tolist(), lasts.tolist(), strict=True)
    same = [(first, last) for first, last in pairs if one.same_rays(first, other, last)]
    return np.array(same, np.intp).reshape(-1, 2)


def link_by_frame(one: Session, first: int, last: int) -> Loop:
    """Return the link from a drive to another one that has its frame ``first`` as ``last``."""
    points = len(one.rays(first)[0].sigma_m)
    return Loop(first, last, np.eye(4), _INFORMATION * np.eye(6), points, 1.0, same_frame=True)


def seen_before(map_: MapFile, session: Session) -> frozenset[int]:
    """Return the frames of a drive that an earlier one has in the map: no evidence of its own."""
    linked = map_.linked
    earlier, placed = linked[: linked.index(session)], map_.placed
    return frozenset(
        last
        for one in earlier
        for first, last in shared_frames(one, session).tolist()
        if placed[one.number][first]
    )
