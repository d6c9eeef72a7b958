"""The drives of a map placed beside one another by links and measured positions: a pose graph."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.core.errors import RegistrationError
from recon.core.geometry.alignment import fit_upright
from recon.core.geometry.se3 import apply, invert, orthonormalise
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.sessions.linking import find_links, path_up_to
from recon.map.store.map_file import MapFile
from recon.map.store.record_values import Link
from recon.map.store.session import ALONE, BENT, NO_LOOPS, Session
from recon.places.closure import DrivePath, Tie, join_drives
from recon.places.fixes import Held
from recon.places.loop import Loop


@dataclass(frozen=True, eq=False)
class _Joined:
    """Drives that are held together.

    Attributes:
        paths: The path of each by its number, in the world of the first.
        links: The links that hold them.
    """

    paths: dict[int, Trajectory]
    links: list[Link]


def join_new(map_: MapFile, new: Collection[int]) -> None:
    """Find the links of new drives, and place all drives of the map, see `join_sessions`.

    Args:
        map_: The map, which is written.
        new: Numbers of the drives that are new in it.
    """
    join_sessions(map_, [*map_.links, *find_links(map_, new)])


def join_sessions(map_: MapFile, links: Sequence[Link]) -> None:
    """Place the drives that links hold together; keep the links, and which drives those are.

    The first drive stays where it is, and its axes are those of the map. Drives that no link holds
    stay apart. Paths along which positions were measured are bent to run through them.

    Args:
        map_: The map, which is written.
        links: All links between its drives.
    """
    joined = _held_together(map_, links)
    for session in map_.sessions:
        if session.number in joined.paths:
            _place(map_, session, joined.paths[session.number])
        elif ALONE in session.loops:
            session.set_loops({**session.loops, BENT: session.loops[ALONE]})
    kept = set(map(id, joined.links))
    linked = joined.paths or [map_.sessions[0].number]
    map_.set_links([replace(link, kept=id(link) in kept) for link in links], [*linked])


def _held_together(map_: MapFile, links: Sequence[Link]) -> _Joined:
    """Solve the graph until all of its drives are held by links that it believes."""
    while True:
        places = _reached(map_, links)
        inside = [link for link in links if set(link.sessions) <= set(places)]
        if len(places) == 1 and not len(map_.sessions[0].fixes):
            return _Joined({}, [])
        joined = _solve(map_, places, inside)
        if not joined.paths and not inside:
            raise RegistrationError(
                "measured positions bend a path more than its drift explains",
                where=", ".join(map_.session(number).info.source for number in places),
                hint="have they its clock, metres, and the offset of the antenna?",
            )
        if joined.paths and set(_reached(map_, joined.links)) == set(places):
            return joined
        links = joined.links


def _reached(map_: MapFile, links: Sequence[Link]) -> dict[int, Float64]:
    """Return about where the drives are that links or measured positions connect with the first.

    Returns:
        By number, ``T_world_session`` (4, 4), in the world of the first.
    """
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
        T_one_other = _motion(map_.session(one), map_.session(other), bridge.loop)
        if one in found:
            found[other] = orthonormalise(found[one] @ T_one_other)
        else:
            found[one] = orthonormalise(found[other] @ invert(T_one_other))


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


def _motion(one: Session, other: Session, loop: Loop) -> Float64:
    """Return ``T_one_other`` (4, 4) between the worlds of two drives, by one link."""
    T_one_first = one.trajectory.T_world_camera[loop.first]
    T_other_last = other.trajectory.T_world_camera[loop.last]
    return np.asarray(T_one_first @ loop.T_first_last @ invert(T_other_last))


def _solve(map_: MapFile, places: dict[int, Float64], links: Sequence[Link]) -> _Joined:
    """Solve the pose graph of some drives, with their own loops and the links between them."""
    numbers = list(places)
    sessions = [map_.session(number) for number in numbers]
    drives = [_drive(session, places[session.number]) for session in sessions]
    loops = [
        Tie((place, place), Loop(**loop))
        for place, session in enumerate(sessions)
        for loop in session.loops.get("closed", ())
    ]
    ties = [Tie(_places(numbers, link), link.loop) for link in links]
    joined = join_drives(drives, [*loops, *ties], _held(map_, sessions, drives))
    if joined is None:
        return _Joined({}, [])
    kept = joined.kept[len(loops) :]
    believed = [link for link, keep in zip(links, kept, strict=True) if keep]
    return _Joined(dict(zip(numbers, joined.trajectories, strict=True)), believed)


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


def _places(numbers: list[int], link: Link) -> tuple[int, int]:
    """Return the two drives of a link, by their place among the numbers."""
    one, other = map(numbers.index, link.sessions)
    return one, other


def _drive(session: Session, T_world_session: Float64) -> DrivePath:
    """Return a drive where it is about, for the pose graph."""
    poses = T_world_session @ session.odometry.T_world_camera
    return DrivePath(replace(session.odometry, T_world_camera=poses), path_up_to(session))


def _place(map_: MapFile, session: Session, path: Trajectory) -> None:
    """Write where a drive is: its axes, and how its path is bent."""
    T_world_session = path.T_world_camera[0] @ invert(session.odometry.T_world_camera[0])
    bent = invert(T_world_session) @ path.T_world_camera
    loops = {**NO_LOOPS, **session.loops}
    alone = loops.get(ALONE, loops[BENT])
    session.set_loops({**loops, ALONE: alone, BENT: bent})
    first = map_.sessions[0]
    if session is not first:
        session.set_axes(first.T_map_world @ T_world_session, session.camera)
