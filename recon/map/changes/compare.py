"""What changed between the drives of two days, by the tests for what moved as one body.

What went are points of the day before that moved, if all that the day after looked through counts
as later; what came is the same with the days swapped. So what either day saw badly or through gaps,
and what lies within the error of depths of a surface, is no change: `recon.map.occupancy.moving`.
What moved within a day is in neither of its clouds. A point is the same, in any case, where the
other day has one as near as two voxels and the error of depths explain: a roof seen at a grazing
angle is looked through as one body. But not where surfaces were displaced by more than the error
that the map has (`displaced.py`): one replaced the other. What is neither was not compared: the
other day did not look there, or not so that it could tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final, cast

import numpy as np
from scipy.spatial import cKDTree

from recon.core.errors import MappingError
from recon.core.values import PointCloud, join_clouds
from recon.core.values.arrays import Float32, UInt8
from recon.map.builders import FREE_MARGIN_SIGMAS, Submap
from recon.map.changes.displaced import find_displaced
from recon.map.changes.objects import CAME, NOT_COMPARED, SAME, WENT, ChangedObject, Day, objects_of
from recon.map.occupancy.bodies import FrameObservations
from recon.map.occupancy.moving import find_moved
from recon.map.sessions.copying import check_session, copy_sessions, same_drives
from recon.map.sessions.joining import join_new
from recon.map.sessions.placed import PlacedSubmaps, observations_of, settings_of
from recon.map.store.map_file import MapFile
from recon.map.store.session import Session, Submaps
from recon.map.tiles import Tiles

_MARGIN_CELLS: Final = 16  # around a tile; the tests depend on what is up to ten cells away


@dataclass(frozen=True, eq=False)
class Comparison:
    """What came and went between two days."""

    before: Day
    after: Day
    objects: Sequence[ChangedObject]

    @property
    def counts(self) -> dict[str, int]:
        return {kind: sum(one.change == kind for one in self.objects) for kind in ("came", "went")}


def gather(map_: MapFile, before: MapFile, after: MapFile) -> list[int]:
    """Put drives of two maps into an empty one and link them; return those that only ``after`` has.

    Raises:
        MappingError: No drive of the second is linked, or it has none of its own.
        SettingsError: Voxels of two sizes, or rays too coarse for one.
    """
    for session in (*before.sessions, *after.sessions):
        check_session(session, settings_of(before.first))
    known, where = same_drives(before, after), after.store.name
    if len(known) == len(after.sessions):
        what = "the second map has no drive that the first one lacks"
        older = len(before.sessions) > len(known)
        hint = "name the older one first" if older else "both maps are of the same drives"
        raise MappingError(what, where=where, hint=hint)
    copy_sessions(before, map_)
    new = copy_sessions(after, map_, without=known)
    join_new(map_, new)
    linked = [session.number for session in map_.linked if session.number in new]
    if not linked:
        what = f"no place is seen to be one of {before.store.name}, so nothing can be compared"
        raise MappingError(what, where=where, expected="drives through one place")
    return linked


def compare(map_: MapFile, newer: Sequence[int], threads: int = 1) -> Comparison:
    """Compare the linked drives of a map with those of some numbers among them, which are later."""
    settings = settings_of(map_.first)
    fusion = settings.fusion.model_copy(update={"remove_moving": True})
    settings = settings.model_copy(update={"fusion": fusion})
    placed = PlacedSubmaps(map_, settings)
    made, ends = placed.made(threads), np.cumsum([0, *placed.drives]).tolist()
    rows = {one.number: range(*ends[n : n + 2]) for n, one in enumerate(map_.linked)}

    def tiles_of(*drives: Sequence[Session]) -> Tiles:
        """Return tiles of groups of sessions, each of which counts as one drive, in that order."""
        sessions = [*chain(*drives)]
        chosen = _Chosen(made, [row for one in sessions for row in rows[one.number]])
        counts = [sum(len(rows[one.number]) for one in drive) for drive in drives]
        tiles = Tiles.of_submaps(chosen, settings, map_.first.T_map_world, drives=counts)
        tiles.observations = observations_of(map_, settings, sessions)
        return tiles

    days, sides = [], [[one for one in map_.linked if (one.number in newer) == n] for n in (0, 1)]
    own = [tiles_of(*([one] for one in sessions)) for sessions in sides]
    for n, kind in enumerate((WENT, CAME)):
        parts = [*_classified(own[n], own[1 - n], tiles_of(sides[n], sides[1 - n]), kind)]
        cloud = join_clouds(part for part, _ in parts)
        classes = np.concatenate([np.zeros(0, np.uint8), *(found for _, found in parts)])
        seen = cast("FrameObservations", own[n].observations)  # all have rays
        days.append(Day(sides[n], seen, cloud, classes, np.zeros(len(cloud), np.bool_)))
    before, after = days
    if not (len(before.cloud) or len(after.cloud)):
        raise MappingError("neither map has a point to compare", where=map_.store.name)
    displaced = find_displaced(before.cloud, after.cloud, own[0].resolution_m)
    before, after = (
        replace(day, classes=np.where(off, np.uint8(kind), day.classes), displaced=off)
        for day, off, kind in zip(days, displaced, (WENT, CAME), strict=True)
    )
    found = [*objects_of(before, after, WENT), *objects_of(after, before, CAME)]
    found.sort(key=lambda changed: -changed.points)
    return Comparison(before, after, [replace(one, number=n) for n, one in enumerate(found, 1)])


@dataclass(frozen=True)
class _Chosen:
    """Some submaps by their numbers, read when they are reached, as often as they are asked for."""

    made: Submaps
    numbers: Sequence[int]

    def __iter__(self) -> Iterator[Submap]:
        return map(self.made.__getitem__, self.numbers)


def _classified(
    own: Tiles, others: Tiles, both: Tiles, kind: int
) -> Iterator[tuple[PointCloud, UInt8]]:
    """Yield the points of a day tile by tile, and the class of each."""
    seen, fusion = cast("FrameObservations", both.observations), both.config.fusion
    for tile in both:
        bounds = both.bounds(tile.key)
        around = bounds.wider(_MARGIN_CELLS * both.resolution_m)
        cloud, other = own.cloud_in(around), others.cloud_in(around)
        if not len(cloud):
            continue
        points, frames = cloud.xyz.astype(np.float64), 1 if cloud.count is None else cloud.count
        sigma_m = np.asarray(_sigma_m(cloud) * np.sqrt(frames), np.float32)  # in a frame
        found = np.full(len(cloud), NOT_COMPARED, np.uint8)
        if len(other):
            distance_m, row = cKDTree(other.xyz).query(points)
            error_m = np.hypot(_sigma_m(cloud), _sigma_m(other)[row])
            reach_m = 2 * fusion.largest_voxel_m + FREE_MARGIN_SIGMAS * error_m
            found[distance_m <= reach_m] = SAME
        voxels, evidence = both.wide_voxels(tile.key), both.evidence(tile.key, 0)
        counted = np.ones(len(cloud), np.bool_)
        moved = find_moved(points, sigma_m, counted, voxels, evidence, seen)
        found[moved & (found != SAME)] = kind
        inside = bounds.contains(cloud.xyz)
        yield cloud.select(inside), found[inside]


def _sigma_m(cloud: PointCloud) -> Float32:
    """Return float32 (N,), standard deviation of each fused point; 0 where it is not known."""
    return np.zeros(len(cloud), np.float32) if cloud.sigma_m is None else cloud.sigma_m
