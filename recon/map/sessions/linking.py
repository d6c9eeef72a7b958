"""Places that two drives of a map saw, found by their keyframes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from recon.core.values.arrays import Float64
from recon.map.sessions.shared_frames import link_by_frame, shared_frames
from recon.map.store.map_file import MapFile, MapViews
from recon.map.store.record_values import Link
from recon.map.store.session import Session
from recon.odometry.health import stretches
from recon.places.detector import KnownPlaces, KnownView
from recon.places.loop import Loop, agreeing_loops
from recon.places.places import path_lengths


def find_links(map_: MapFile, new: Collection[int]) -> list[Link]:
    """Return the places that new drives of a map and the drives before them saw.

    Drives that have frames in common are linked by them. Besides, each keyframe of a new drive is
    looked for among those of the others; what is recognised counts only where neighbouring
    keyframes say the same and none of them anything else, so that streets that look alike give no
    link.

    Args:
        map_: The map, with the drives that share its axes marked as linked.
        new: Numbers of the drives that are new in it.
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
    """Return float64 (N,), path of a drive up to each frame; lost frames count several times.

    Of known poses it is 0 everywhere: odometry, whose drift grows with the path, had no part in it.
    """
    if all(record.known for record in session.health):
        return np.zeros(len(session))
    return path_lengths(session.odometry.T_world_camera, session.trusted)


def _between(map_: MapFile, group: Sequence[int], new: Session) -> list[Link]:
    """Return the links from drives that share axes to a new one."""
    links, theirs, own = [], set(), set()
    for number in group:
        other = map_.session(number)
        shared = shared_frames(other, new).tolist()
        ones, news = stretches(other.health), stretches(new.health)
        # One for each two stretches: nothing else may say where those behind a lost pose are.
        last = {(int(ones[first]), int(news[last])): (first, last) for first, last in shared}
        links += [Link((number, new.number), link_by_frame(other, *pair)) for pair in last.values()]
        theirs |= {(number, first) for first, _ in shared}
        own |= {last for _, last in shared}
    views = MapViews(map_, group)
    # What a frame that both have shows again is a loop of either drive alone, which knows it.
    loops = [
        loop for loop in _recognised(views, new, own) if _frame_of(views[loop.first]) not in theirs
    ]
    return links + _confirmed(loops, views, new)


def _recognised(views: MapViews, new: Session, without: Collection[int]) -> list[Loop]:
    """Return what keyframes of a drive show of the places of others; ``first`` is a view."""
    known = KnownPlaces(views)
    loops: list[Loop] = []
    if len(known):
        for stored in new.keyframes:
            if stored.keyframe.frame not in without:
                loops += known.recognise(stored.keyframe, new.camera).loops
    return loops


def _confirmed(loops: Sequence[Loop], views: MapViews, new: Session) -> list[Link]:
    """Return links by the loops that neighbouring ones confirm."""
    if not loops:
        return []
    path_m, poses = path_up_to(new), new.odometry.T_world_camera
    # The other drives are finished: what they drifted is corrected as far as it is known.
    firsts = {loop.first: (views[loop.first].T_world_camera, 0.0) for loop in loops}
    lasts = {loop.last: (poses[loop.last], float(path_m[loop.last])) for loop in loops}
    return [
        Link((views[loop.first].session, new.number), _of_frames(loop, views))
        for loop in agreeing_loops(loops, firsts, lasts)
    ]


def _frame_of(view: KnownView) -> tuple[int, int]:
    """Return the drive and the frame of a view."""
    return view.session, view.keyframe.frame


def _of_frames(loop: Loop, views: MapViews) -> Loop:
    """Return a loop from a view as one from its frame."""
    return replace(loop, first=views[loop.first].keyframe.frame)
