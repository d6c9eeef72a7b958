"""Places that two drives of a map saw, found by their keyframes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from recon.core.values.arrays import Float64
from recon.map.store.links import Link
from recon.map.store.map import Map
from recon.map.store.session import Session
from recon.map.store.views import MapViews
from recon.places.agree import agreeing_loops
from recon.places.drift import DriftModel, path_lengths
from recon.places.known import KnownPlaces
from recon.places.verify import Loop

DRIFT = DriftModel()


def find_links(map_: Map, new: Collection[int]) -> list[Link]:
    """Return the places that new drives of a map and the drives before them saw.

    Each keyframe of a new drive is looked for among those of the others. What is recognised counts
    only where neighbouring keyframes say the same and none of them anything else, so that streets
    that look alike give no link.

    Args:
        map_: The map, with the drives that share its axes marked as linked.
        new: Numbers of the drives that are new in it.

    Raises:
        FormatError: A keyframe is damaged.
    """
    links = []
    before = [session.number for session in map_.sessions if session.number not in new]
    linked = {session.number for session in map_.linked}
    for number in new:
        together = [n for n in before if n in linked]
        for group in (together, *([n] for n in before if n not in linked)):
            links += _between(map_, group, map_.session(number)) if group else []
        before.append(number)
    return links


def path_up_to(session: Session) -> Float64:
    """Return float64 (N,), path of a drive up to each frame; lost frames count several times."""
    trusted = np.array([health.ok for health in session.health])
    return path_lengths(session.odometry.T_world_camera, trusted)


def _between(map_: Map, group: Sequence[int], new: Session) -> list[Link]:
    """Return the links from drives that share axes to a new one."""
    views = MapViews(map_, group)
    known = KnownPlaces(views)
    if not len(known) or not len(new):
        return []
    loops: list[Loop] = []
    for stored in new.keyframes:
        loops += known.recognise(stored.keyframe, new.camera).loops
    if not loops:
        return []
    path_m, poses = path_up_to(new), new.odometry.T_world_camera
    # The other drives are finished: what they drifted is corrected as far as it is known.
    firsts = {loop.first: (known.T_world_camera[loop.first], 0.0) for loop in loops}
    lasts = {loop.last: (poses[loop.last], float(path_m[loop.last])) for loop in loops}
    return [
        Link((views[loop.first].session, new.number), _of_frames(loop, views))
        for loop in agreeing_loops(loops, firsts, lasts, DRIFT)
    ]


def _of_frames(loop: Loop, views: MapViews) -> Loop:
    """Return a loop from a view as one from its frame."""
    return replace(loop, first=views[loop.first].keyframe.frame)
