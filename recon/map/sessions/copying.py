"""Drives that go from one map into another, or into one file that is kept, also piece by piece."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import orthonormalise
from recon.core.text import counted
from recon.core.values.arrays import Float64
from recon.map.builders import Submap
from recon.map.ground.level import Level
from recon.map.occupancy.part import join_occupancy
from recon.map.sessions.joining import T_one_other, link_by_frame
from recon.map.sessions.placed import check_rays
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile
from recon.map.store.records import Key
from recon.map.store.session import (
    AXES,
    ENTRY,
    IMAGES,
    KEYFRAME,
    LOOPS,
    SESSION,
    SUBMAP,
    THINNED,
    Session,
)
from recon.map.store.trees import FRAMES, RAYS, RIG
from recon.odometry.health import segment_numbers
from recon.places.detector import LoopDetector, StoredKeyframe
from recon.places.places import path_lengths

KINDS: Final = (SESSION, AXES, RIG, FRAMES, LOOPS, KEYFRAME, RAYS, SUBMAP, ENTRY, THINNED)
"""Records of a drive, whose keys begin with its number."""


def copy_sessions(source: MapFile, target: MapFile, without: Collection[int] = ()) -> list[int]:
    """Copy drives of a map into another one, with the links between them; their numbers there.

    They keep their numbers where the other map is empty, else they get the next ones.
    """
    chosen = [session for session in source.sessions if session.number not in without]
    known = same_drives(target, source)
    for session in chosen:  # one that a map has already would be evidence of its own
        if session.number in known:
            raise FormatError(
                "the map has this drive already",
                where=session.where,
                got=f"{session.info.source}, {counted(len(session), 'frame')}",
                expected="another drive",
            )
    after, left = target.next_number, source.forgotten
    known_there = [*(session.number for session in chosen), *(one.number for one in left)]
    first = min(known_there, default=0) if after else 0
    numbers = {session.number: session.number - first + after for session in chosen}
    if left:
        moved = [replace(one, number=one.number - first + after) for one in left]
        target.set_forgotten([*target.forgotten, *moved])
    for kind in KINDS:
        keys: dict[Key, Key] = {}
        for key in source.store.keys(kind):
            number, *rest = key if isinstance(key, tuple) else (key,)
            if number in numbers:
                keys[key] = (numbers[number], *rest) if rest else numbers[number]
        source.store.copy(kind, target.store, keys)
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


def same_drives(one: MapFile, other: MapFile) -> list[int]:
    """Return the numbers of the drives of another map that one has, too, by their paths."""
    paths = [session.odometry for session in one.sessions]
    return [
        session.number
        for session in other.sessions
        if any(
            np.array_equal(path.T_world_camera, session.odometry.T_world_camera)
            and np.array_equal(path.timestamps_s, session.odometry.timestamps_s)
            for path in paths
        )
    ]


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
            # How well it is level is found by the whole drive.
            session.mount, session.level = part.mount, Level(part.level.by, why=part.level.why)
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
        for one in part.submaps:
            frames = one.frames - max(0, lead - one.first_frame)
            if frames > 0:
                # Occupancy is made of rays, as where they lie is known now.
                nothing = one.occupancy.select(np.zeros(len(one.occupancy.rows.blocks), np.bool_))
                fused = one.fused
                if lead:
                    fused = fused.moved(T_world_part, settings.fusion.voxel_m).rounded()
                number, first = len(session.submaps), session.submaps.frames
                session.submaps.add(Submap(number, first, frames, fused, nothing))
        poses = session.odometry.T_world_camera
        path_m = path_lengths(poses, session.trusted, settings.scale)
        segment = segment_numbers(session.health)
        for stored in part.keyframes:
            if stored.keyframe.frame >= lead:
                frame = begin + stored.keyframe.frame
                keyframe = replace(stored.keyframe, frame=frame)
                pose, along_m = poses[frame], float(path_m[frame])
                detector.look(StoredKeyframe(keyframe, pose, along_m, int(segment[frame])))


def keep_map(mapped: MapFile, path: Path) -> None:
    """Write the map of finished drives, but for occupancy, which is made of rays again."""
    nothing = join_occupancy(())
    with MapFile.create(path) as kept:
        for session in mapped.sessions:
            start = {name: kept_ for name, kept_ in session.info.start.items() if name == IMAGES}
            new = kept.begin(replace(session.info, start=start))
            for number, T_world_camera in enumerate(session.odometry.T_world_camera):
                time_s = float(session.odometry.timestamps_s[number])
                new.add_frame(T_world_camera, time_s, session.health[number])
            for submap in session.submaps:
                new.submaps.add(replace(submap, occupancy=nothing), compress=True)
        for kind in (AXES, RIG, LOOPS, KEYFRAME, RAYS):
            mapped.store.copy(kind, kept.store)
        kept.commit()


def read_all(map_: MapFile) -> None:
    """Read what `copy_sessions` copies unread, to find the record that is damaged."""
    for session in map_.sessions:
        for _ in chain(session.submaps, session.keyframes):
            pass
        for frame in map_.store.numbers(RAYS, session.number):
            session.rays(frame)


def check_session(session: Session, settings: DriveSettings) -> None:
    """Refuse a drive that cannot become part of a map with these settings."""
    config = session.info.config
    voxel_m = config.get("fusion", {}).get("voxel_m")
    if voxel_m != settings.fusion.voxel_m:
        same = f"fusion.voxel_m={settings.fusion.voxel_m:g}"
        if config.get("scene", {}).get("scale") != settings.scale:
            same = f"scene.scale={settings.scale:g}"
        raise SettingsError(
            "the clouds of the maps have voxels of different sizes",
            where=session.where,
            got=f"{voxel_m} m",
            expected=f"{settings.fusion.voxel_m:g} m",
            hint=f"map it again with --set {same}, or into the run of the others with --into",
        )
    check_rays(session, settings)


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
