"""Drives copied from one map into another."""

from __future__ import annotations

from collections.abc import Collection
from itertools import chain

import numpy as np

from recon.core.errors import FormatError, SettingsError
from recon.core.text import counted
from recon.map.settings import DriveSettings
from recon.map.store.finished import check_rays
from recon.map.store.map_file import MapFile
from recon.map.store.record_values import FRAMES, RAYS
from recon.map.store.records import Key
from recon.map.store.session import AXES, ENTRY, KEYFRAME, LOOPS, SESSION, SUBMAP, Session

_KINDS = (SESSION, AXES, FRAMES, LOOPS, KEYFRAME, RAYS, SUBMAP, ENTRY)


def copy_sessions(source: MapFile, target: MapFile, without: Collection[int] = ()) -> list[int]:
    """Copy the drives of a map into another one, with the links between them.

    They keep their numbers where the other map is empty, else they get the next ones.

    Args:
        source: The map to copy from.
        target: The map to copy to.
        without: Numbers of drives that are not copied.

    Returns:
        Their numbers in the other map.
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
        link.between(numbers[link.sessions[0]], numbers[link.sessions[1]])
        for link in source.links
        if all(number in numbers for number in link.sessions)
    ]
    kept = [session.number for session in target.linked]
    target.set_links([*target.links, *links], kept or linked)
    target.sessions += [Session(target.store, number) for number in numbers.values()]
    return list(numbers.values())


def read_all(map_: MapFile) -> None:
    """Read what `copy_sessions` copies unread.

    Raises:
        FormatError: A record is damaged.
    """
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
            hint="map one of the drives again with --set fusion.voxel_m=",
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
