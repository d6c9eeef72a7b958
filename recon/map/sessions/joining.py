"""How drives come to lie in one frame: linked by what two of them have or saw, or as measured.

1. A frame that two drives have, since recordings overlap or one drive was cut, links them exactly.
2. A keyframe of a drive that shows a place of another one links them as well as it was measured.
3. Positions that were measured along drives place them in the coordinates of one survey.

From all these comes one pose graph, in which links that contradict the others are not believed.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import RegistrationError
from recon.core.geometry.alignment import fit_points, fit_upright
from recon.core.geometry.se3 import apply, invert, orthonormalise
from recon.core.progress import tracked
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.store.map_file import MapFile, MapViews
from recon.map.store.session import NO_LOOPS, OPTIMISED_POSES, POSES_BEFORE_LINKS, Session
from recon.map.store.trees import Link
from recon.odometry.health import segment_numbers
from recon.places.closure import Constraint, DrivePath, join_drives
from recon.places.detector import KnownPlaces
from recon.places.places import Loop, agreeing_loops
from recon.places.pose_graph import Held

_INFORMATION: Final = 1e8  # of what is the same: 0.1 mm and 0.1 mrad, as no covariance may be zero
_FEWEST: Final = 5  # links from which a scale is estimated, besides six parameters of the place
_LARGEST: Final = 0.02
"""Difference that drift explains: twice what odometry is expected to be off by in each drive."""
_SIGMAS: Final = 4.0


def join_new(map_: MapFile, new: Collection[int]) -> None:
    """Find the links of new drives, by number, and place all drives of the map: `join_sessions`."""
    join_sessions(map_, [*map_.links, *find_links(map_, new)])


def join_sessions(map_: MapFile, links: Sequence[Link]) -> None:
    """Place the drives that links hold together; keep the links, and which drives those are.

    The first drive stays where it is, and its axes are those of the map. Drives that no link holds
    stay apart. Paths along which positions were measured are optimised to run through them.
    """
    paths, believed = _held_together(map_, links)
    for session in map_.sessions:
        if session.number in paths:
            path, loops = paths[session.number].T_world_camera, {**NO_LOOPS, **session.loops}
            T_world_session = path[0] @ invert(session.odometry.T_world_camera[0])
            before = loops.get(POSES_BEFORE_LINKS, loops[OPTIMISED_POSES])
            optimised = invert(T_world_session) @ path
            session.set_loops({**loops, POSES_BEFORE_LINKS: before, OPTIMISED_POSES: optimised})
            if session is not map_.sessions[0]:
                T_map_session = map_.sessions[0].T_map_world @ T_world_session
                session.set_axes(T_map_session, session.camera)
        elif POSES_BEFORE_LINKS in session.loops:
            session.set_loops({**session.loops, OPTIMISED_POSES: session.loops[POSES_BEFORE_LINKS]})
    kept, linked = set(map(id, believed)), paths or [map_.sessions[0].number]
    map_.set_links([replace(link, kept=id(link) in kept) for link in links], [*linked])


def find_links(map_: MapFile, new: Collection[int]) -> list[Link]:
    """Return the places that new drives of a map, by number, and the drives before them saw.

    Drives that have frames in common are linked by them. Besides, each keyframe of a new drive is
    looked for among those of the others; what is recognised counts only where neighbouring
    keyframes say the same and none of them anything else, so that streets that look alike give no
    link.
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


def shared_frames(one: Session, other: Session) -> NDArray[np.intp]:
    """Return int (K, 2), the frames that two drives of one map share, by number in either.

    A frame is known by its time and its rays. These are computed from its images alone, so those of
    the same images are equal to the last bit, and those of others never are.
    """
    times_s, others_s = one.odometry.timestamps_s, other.odometry.timestamps_s
    _, firsts, lasts = np.intersect1d(times_s, others_s, return_indices=True)
    pairs = zip(firsts.tolist(), lasts.tolist(), strict=True)
    same = [(first, last) for first, last in pairs if one.same_rays(first, other, last)]
    return np.array(same, np.intp).reshape(-1, 2)


def link_by_frame(one: Session, first: int, last: int) -> Loop:
    """Return the link from a drive to another one that has its frame ``first`` as ``last``."""
    points = len(one.rays(first)[0].sigma_m)
    return Loop(first, last, np.eye(4), _INFORMATION * np.eye(6), points, 1.0, same_frame=True)


def T_one_other(one: Session, other: Session, loop: Loop) -> Float64:
    """Return float64 (4, 4), by one link, between the worlds of two drives."""
    T_one_first = one.trajectory.T_world_camera[loop.first]
    T_other_last = other.trajectory.T_world_camera[loop.last]
    return np.asarray(T_one_first @ loop.T_first_last @ invert(T_other_last))


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


def path_up_to(session: Session) -> Float64:
    """Return float64 (N,), path up to each frame; lost frames count more, known poses 0."""
    return DrivePath.of(session.odometry, session.health, session.scale).path_m


def doubts_of_lengths(map_: MapFile) -> list[str]:
    """Return a line for each two drives, one of which finds the same street longer."""
    kept = sorted((link for link in map_.links if link.kept), key=lambda link: link.sessions)
    lines = []
    for (one, other), links in groupby(kept, key=lambda link: link.sessions):
        paths = (map_.session(one).odometry, map_.session(other).odometry)
        longer = times_as_long(*paths, [link.loop for link in links])
        if longer is not None and abs(longer[0] - 1.0) > max(_LARGEST, _SIGMAS * longer[1]):
            lines.append(
                f"between places that both observed, session {one} is {longer[0]:.3f} times as "
                f"long as session {other}: the baseline of one rig is off, or a drive has drifted"
            )
    return lines


def times_as_long(
    one: Trajectory, other: Trajectory, links: Sequence[Loop]
) -> tuple[float, float] | None:
    """Return how many times as long one path is as another, and its standard deviation.

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


def _between(map_: MapFile, group: Sequence[int], new: Session) -> list[Link]:
    """Return the links from drives that share axes to a new one."""
    links, theirs, own = [], set(), set()
    for number in group:
        other = map_.session(number)
        shared = shared_frames(other, new).tolist()
        ones, news = segment_numbers(other.health), segment_numbers(new.health)
        # One for each two segments: nothing else may say where those behind a lost pose are.
        both = [(int(ones[first]), int(news[last]), first, last) for first, last in shared]
        last = {
            (one, other): (first, last) for one, other, first, last in both if min(one, other) >= 0
        }
        links += [Link((number, new.number), link_by_frame(other, *pair)) for pair in last.values()]
        theirs |= {(number, first) for first, _ in shared}
        own |= {last for _, last in shared}
    views = MapViews(map_, group)
    # What a frame that both have shows again is a loop of either drive alone, which knows it.
    known = KnownPlaces(views, new.scale)
    loops = [
        loop
        for stored in (tracked(new.keyframes, "keyframes", "find places") if len(known) else ())
        if stored.keyframe.frame not in own
        for loop in known.recognise(stored.keyframe, new.camera).loops
        if views.keys[loop.first] not in theirs
    ]
    return links + _confirmed(loops, views, new)


def _confirmed(loops: Sequence[Loop], views: MapViews, new: Session) -> list[Link]:
    """Return links by the loops from views that neighbouring ones confirm."""
    if not loops:
        return []
    path_m, poses = path_up_to(new), new.odometry.T_world_camera
    # The other drives are finished: what they drifted is corrected as far as it is known.
    of = segment_numbers(new.health).tolist()
    firsts = {loop.first: (views[loop.first].T_world_camera, 0.0, 0) for loop in loops}
    lasts = {n: (poses[n], float(path_m[n]), of[n]) for n in {loop.last for loop in loops}}
    links = []
    for loop in agreeing_loops(loops, firsts, lasts, scale=new.scale):
        number, frame = views.keys[loop.first]
        links.append(Link((number, new.number), replace(loop, first=frame)))
    return links


def _held_together(
    map_: MapFile, links: Sequence[Link]
) -> tuple[dict[int, Trajectory], Sequence[Link]]:
    """Solve the graph until believed links hold all its drives; return paths and these."""
    while True:
        places = _reached(map_, links)
        inside = [link for link in links if set(link.sessions) <= set(places)]
        if len(places) == 1 and not len(map_.sessions[0].fixes):
            return {}, []
        paths, believed = _solve(map_, places, inside)
        if not paths and not inside:
            raise RegistrationError(
                "measured positions deform a path more than its drift explains",
                where=", ".join(map_.session(number).info.source for number in places),
                hint="have they its clock, metres, and the offset of the antenna?",
            )
        if paths and set(_reached(map_, believed)) == set(places):
            return paths, believed
        links = believed


def _reached(map_: MapFile, links: Sequence[Link]) -> dict[int, Float64]:
    """Return ``T_world_session``, about, of drives that links or positions connect."""
    found = {map_.sessions[0].number: np.eye(4)}
    surest = sorted(links, key=lambda link: -link.loop.inliers)
    while True:
        bridges = (link for link in surest if sum(n in found for n in link.sessions) == 1)
        bridge = next(bridges, None)
        if bridge is None and (measured := _by_survey(map_, found)):
            found |= measured
            continue
        if bridge is None:
            return found
        one, other = bridge.sessions
        T = T_one_other(map_.session(one), map_.session(other), bridge.loop)
        if one in found:
            found[other] = orthonormalise(found[one] @ T)
        else:
            found[one] = orthonormalise(found[other] @ invert(T))


def _by_survey(map_: MapFile, found: dict[int, Float64]) -> dict[int, Float64]:
    """Return about where the next drive is that only measured positions place beside others."""
    held = [session for session in map_.sessions if len(session.fixes)]
    there = [session for session in held if session.number in found]
    away = [session for session in held if session.number not in found]
    if not there or not away:
        return {}
    T_map_world, new = map_.first.T_map_world, away[0]
    paths = [
        apply(T_map_world @ found[one.number], one.fixes.by_path(one.odometry)) for one in there
    ]
    surveyed = np.concatenate([one.fixes.position_m for one in there])
    T_map_survey = fit_upright(surveyed, np.concatenate(paths)).T_to_from
    own_m = apply(new.T_map_world, new.fixes.by_path(new.odometry))
    T_map_own = fit_upright(own_m, apply(T_map_survey, new.fixes.position_m)).T_to_from
    return {new.number: orthonormalise(invert(T_map_world) @ T_map_own @ new.T_map_world)}


def _solve(
    map_: MapFile, places: dict[int, Float64], links: Sequence[Link]
) -> tuple[dict[int, Trajectory], list[Link]]:
    """Solve the pose graph of some drives, with their own loops and the links between them."""
    numbers = list(places)
    sessions = [map_.session(number) for number in numbers]
    drives = [
        DrivePath.of(
            replace(one.odometry, T_world_camera=T @ one.odometry.T_world_camera),
            one.health,
            one.scale,
        )
        for one, T in zip(sessions, places.values(), strict=True)
    ]
    loops = [
        Constraint((place, place), loop)
        for place, session in enumerate(sessions)
        for loop in session.closed
    ]
    constraints = [
        Constraint((numbers.index(link.sessions[0]), numbers.index(link.sessions[1])), link.loop)
        for link in links
    ]
    joined = join_drives(drives, [*loops, *constraints], _held(map_, sessions, drives))
    if joined is None:
        return {}, []
    kept = joined.kept[len(loops) :]
    believed = [link for link, keep in zip(links, kept, strict=True) if keep]
    return dict(zip(numbers, joined.trajectories, strict=True)), believed


def _held(map_: MapFile, sessions: Sequence[Session], drives: Sequence[DrivePath]) -> Held | None:
    """Return the positions that were measured along drives; None if there are none."""
    fixes = [session.fixes for session in sessions]
    position_m = np.concatenate([each.position_m for each in fixes])
    if not len(position_m):
        return None
    T_map_world, centre_m = map_.first.T_map_world, position_m.mean(axis=0)
    by_path = [each.by_path(one.trajectory) for each, one in zip(fixes, drives, strict=True)]
    ours_m = apply(T_map_world, np.concatenate(by_path))
    T_map_survey = fit_upright(position_m - centre_m, ours_m).T_to_from
    # Numbers of millions of metres would cost the optimiser digits.
    near = [replace(each, position_m=each.position_m - centre_m) for each in fixes]
    return Held(invert(T_map_world) @ T_map_survey, near)
