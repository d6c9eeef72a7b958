"""Drives that go from one map into another: as drives of their own, or as one after the other."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import chain
from typing import Final

import numpy as np

from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import orthonormalise
from recon.core.text import counted
from recon.core.values.arrays import Float64
from recon.map.sessions.joining import T_one_other, link_by_frame
from recon.map.settings import DriveSettings
from recon.map.store.finished import check_rays
from recon.map.store.map_file import MapFile
from recon.map.store.records import Key
from recon.map.store.session import AXES, ENTRY, KEYFRAME, LOOPS, SESSION, SUBMAP, Session
from recon.map.store.trees import FRAMES, RAYS, RIG
from recon.map.submaps import Submap
from recon.odometry.health import segment_numbers
from recon.places.detector import LoopDetector, StoredKeyframe
from recon.places.places import path_lengths

_KINDS: Final = (SESSION, AXES, RIG, FRAMES, LOOPS, KEYFRAME, RAYS, SUBMAP, ENTRY)


def copy_sessions(source: MapFile, target: MapFile, without: Collection[int] = ()) -> list[int]:
    """Copy drives of a map into another one, with the links between them; their numbers there.

    They keep their numbers where the other map is empty, else they get the next ones.
    """
    chosen = [session for session in source.sessions if session.number not in without]
    for session in chosen:
        _refuse_again(session, target)
    after = max((session.number for session in target.sessions), default=-1) + 1
    first = chosen[0].number if chosen and after else 0
    numbers = {session.number: session.number - first + after for session in chosen}
    for kind in _KINDS:
        source.store.copy(kind, target.store, _renumbered(source.store.keys(kind), numbers))
    linked = [numbers[s.number] for s in source.linked if s.number in numbers]
    links = [
        replace(link, sessions=(numbers[link.sessions[0]], numbers[link.sessions[1]]))
        for link in source.links
        if numbers.keys() >= {*link.sessions}
    ]
    kept = [session.number for session in target.linked]
    target.set_links([*target.links, *links], kept or linked)
    target.sessions += [Session(target.store, number) for number in numbers.values()]
    return list(numbers.values())


def join_parts(
    map_: MapFile, parts: Iterable[tuple[MapFile, int]], settings: DriveSettings
) -> None:
    """Put maps of the parts of a drive, one after the other, into its session, which is empty.

    The first frames of each, so many, are also the last ones of the part before: a frame that both
    have measured says where the part lies, and this link is exact. The motion before and after it
    is as uncertain as in a drive that was never cut. Loops are looked for in the whole drive.
    """
    session = map_.session()
    detector: LoopDetector | None = None
    for part_map, lead in parts:
        part, begin = part_map.session(), len(session) - lead
        if not len(session):
            session.set_axes(part.T_map_world, part.camera)
        detector = detector or LoopDetector(
            session.keyframes, part.camera, search=settings.loops.enabled, scale=settings.scale
        )
        T_world_part = _append_frames(session, part, lead)
        rays = (key[1] for key in part_map.store.keys(RAYS) if isinstance(key, tuple))
        own: dict[Key, Key] = {
            (part.number, frame): (session.number, begin + frame) for frame in rays if frame >= lead
        }
        part_map.store.copy(RAYS, map_.store, own)
        _append_submaps(session, part, lead, T_world_part, settings.fusion.voxel_m)
        poses = session.odometry.T_world_camera
        path_m = path_lengths(poses, session.trusted, settings.scale)
        segment = segment_numbers(session.health)
        for stored in part.keyframes:
            if stored.keyframe.frame >= lead:
                frame = begin + stored.keyframe.frame
                keyframe = replace(stored.keyframe, frame=frame)
                pose, along_m = poses[frame], float(path_m[frame])
                detector.look(StoredKeyframe(keyframe, pose, along_m, int(segment[frame])))


def read_all(map_: MapFile) -> None:
    """Read what `copy_sessions` copies unread, to find the record that is damaged."""
    for session in map_.sessions:
        for _ in chain(session.submaps, session.keyframes):
            pass
        for frame in range(session.ray_frames):
            session.rays(frame)


def check_session(session: Session, settings: DriveSettings) -> None:
    """Refuse a drive that cannot become part of a map with these settings."""
    voxel_m = session.info.config.get("fusion", {}).get("voxel_m")
    if voxel_m != settings.fusion.voxel_m:
        raise SettingsError(
            "the clouds of the maps have voxels of different sizes",
            where=session.where,
            got=f"{voxel_m} m",
            expected=f"{settings.fusion.voxel_m:g} m",
            hint="map one again with --set scene.scale= or fusion.voxel_m= of the other",
        )
    check_rays(session, settings)


def _renumbered(keys: list[Key], numbers: dict[int, int]) -> dict[Key, Key]:
    """Return the keys of some drives, and what they become with new numbers of drives."""
    found: dict[Key, Key] = {}
    for key in keys:
        session, *rest = key if isinstance(key, tuple) else (key,)
        if session in numbers:
            found[key] = (numbers[session], *rest) if rest else numbers[session]
    return found


def _refuse_again(session: Session, target: MapFile) -> None:
    """Refuse a drive that a map has already: it would be evidence of its own."""
    path = session.odometry
    for other in target.sessions:
        known = other.odometry
        if np.array_equal(known.T_world_camera, path.T_world_camera) and np.array_equal(
            known.timestamps_s, path.timestamps_s
        ):
            raise FormatError(
                "the map has this drive already",
                where=session.where,
                got=f"{session.info.source}, {counted(len(session), 'frame')}",
                expected="another drive",
            )


def _append_frames(session: Session, part: Session, lead: int) -> Float64:
    """Add the frames behind the lead of a part to a drive; returns ``T_world_part`` (4, 4)."""
    path, health, T_world_part = part.odometry, part.health, np.eye(4)
    if lead:
        begin = len(session) - lead
        both = session.trusted[begin:] & part.trusted[:lead]
        shared = int(np.flatnonzero(both)[-1]) if both.any() else lead - 1
        link = link_by_frame(session, begin + shared, shared)
        T_world_part = orthonormalise(T_one_other(session, part, link))
    for frame in range(lead, len(part)):
        T_part_camera = path.T_world_camera[frame]
        T = orthonormalise(T_world_part @ T_part_camera) if lead else T_part_camera
        session.add_frame(T, float(path.timestamps_s[frame]), health[frame])
    return T_world_part


def _append_submaps(
    session: Session, part: Session, lead: int, T_world_part: Float64, voxel_m: float
) -> None:
    """Add what a part fused; occupancy is made from its rays, as where they lie is known now."""
    for one in part.submaps:
        frames = one.frames - max(0, lead - one.first_frame)
        if frames > 0:
            fused = one.fused.moved(T_world_part, voxel_m).rounded() if lead else one.fused
            nothing = one.occupancy.select(np.zeros(len(one.occupancy.rows.blocks), np.bool_))
            number, first = len(session.submaps), session.submaps.frames
            session.submaps.add(Submap(number, first, frames, fused, nothing))
