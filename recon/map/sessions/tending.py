"""A map whose size is bounded: of older drives, what newer ones saw again is forgotten.

Space is divided into coarse cells, blocks of occupancy. A cell of a drive is confirmed where enough
newer drives saw it as well: they hit something in it or looked through it, from no more than √2
times as far. The error of a depth grows with the square of the distance, so they see it at most
twice as badly. What an older drive has in confirmed cells says nothing that they do not say. What
too few of its frames saw, what has no place in the map, and what many drives looked towards without
seeing it again, is noise or hidden for good, and goes, too.

A keyframe goes where enough newer drives recognise it: whoever looks like it is recognised by
theirs. So few keyframes of one look are left, and those of other looks stay: another season, rain.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.dates import DAY_S
from recon.core.errors import SettingsError
from recon.core.geometry.se3 import adjoint, apply, invert
from recon.core.kernels.voxels import are_among, find_keys, pack_keys, unpack_keys
from recon.core.progress import tracked
from recon.core.text import counted
from recon.core.values import RayCloud
from recon.core.values.arrays import Bool, Float64, Int64
from recon.core.values.camera import project
from recon.io.files import reading
from recon.map.builders import FREE_MARGIN_SIGMAS
from recon.map.kernels.raycast import BLOCK_EDGE
from recon.map.sessions.copying import KINDS
from recon.map.sessions.keep import Keep
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile, MapViews
from recon.map.store.session import Session, Thinned
from recon.map.store.trees import Forgotten, Link
from recon.places.detector import KnownPlaces

_AS_FAR: Final = math.sqrt(2.0)
_LOOKS: Final = 5
"""Looks of a place that are remembered, each of as many drives as confirm one another: that of now,
and those of four seasons."""
_NEAREST: Final = 2  # keyframes of a drive that one is compared with: before it and behind
_STEPS: Final = 2  # samples of a ray in the length of a coarse edge
_MOST_ROWS: Final = 1 << 20  # cells of single frames that are held before they are joined


def tend(map_: MapFile, settings: DriveSettings, keep: Keep) -> str:
    """Forget what newer drives saw again, what lies outside a region, and drives that are old.

    Drives must be placed; no pose moves. The first drive stays with its poses at least, as the axes
    of the map are its; those that share no place with it stay unless they are old. Returns what was
    forgotten, in a line for people, "" = nothing.
    """
    newest = keep.drives is None or len(map_.linked) <= keep.drives
    if newest and keep.days is None and keep.region is None:
        return ""
    before, old, views = len(map_.sessions), _too_old(map_, keep), _views_to_drop(map_, keep)
    looks = [_Seen(map_, each, settings) for each in tracked(map_.linked, "drives", "look again")]
    rays, left, leaving = 0, 0, old - {map_.first.number}
    for place, seen in enumerate(tracked(looks, "drives", "forget")):
        session, number = seen.session, seen.session.number
        cells = None if keep.drives is None else seen.not_confirmed(looks[place + 1 :], keep.drives)
        cells = np.zeros(0, np.int64) if number in old else cells
        thinned = _thin(seen, cells, keep, views[number])
        rays, left = rays + seen.rays, left + thinned.rays
        voxels = sum(entry.voxels for entry in session.submaps.entries)
        if not (thinned.rays or thinned.keyframes or voxels or session is map_.first):
            leaving.add(number)
    if rays and not left:
        hint = "a region is in metres of the map, days are before its newest drive"
        raise SettingsError("the map would keep nothing", where="--keep", hint=hint)
    if leaving:
        forget(map_, leaving)
    parts = [f"{len(leaving)} of {counted(before, 'drive')}"] if leaving else []
    parts += [f"{100 * (1 - left / rays):.0f} % of the rays"] if left < rays else []
    seen_again = parts and keep.days is None and keep.region is None
    return ", ".join(parts) + (": newer drives saw the same" if seen_again else "")


def forget(map_: MapFile, numbers: Collection[int]) -> None:
    """Take drives out of a map, which remembers that they were there; the others stay in place.

    Links to them become links to the first drive, where their poses say that it was: others may be
    held in the map by nothing else.
    """
    links, linked = _anchored(map_, numbers), {one.number for one in map_.linked}
    gone = [forgotten_of(map_.session(number)) for number in numbers]
    map_.sessions = [session for session in map_.sessions if session.number not in numbers]
    for kind in KINDS:
        for key in map_.store.keys(kind):
            if (key[0] if isinstance(key, tuple) else key) in numbers:
                map_.store.delete(kind, key)
    map_.set_links(links, linked - {*numbers})
    map_.set_forgotten([*map_.forgotten, *gone])


def forgotten_of(session: Session) -> Forgotten:
    """Return what a map remembers of a drive that leaves it now."""
    now = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
    length_m = session.trajectory.path_length_m
    return Forgotten(
        session.number, session.info.source, *session.date, len(session), length_m, now
    )


def _anchored(map_: MapFile, numbers: Collection[int]) -> list[Link]:
    """Return the links of a map without some drives; believed ones to these lead to the first."""
    paths, first, links = map_.paths, map_.first.number, []
    for link in map_.links:
        (one, other), loop = link.sessions, link.loop
        leaving = sum(number in numbers for number in link.sessions)
        if not leaving:
            links.append(link)
        if leaving != 1 or not link.kept or first in link.sessions:
            continue
        begin, end, T, information = loop.first, loop.last, loop.T_first_last, loop.information
        if one not in numbers:  # the drive that stays comes last: errors are in its axes
            turn, T = adjoint(T), invert(T)
            one, other, begin, end = other, one, end, begin
            information = turn.T @ information @ turn
        T_world_left = paths[one].T_world_camera[begin]
        known = np.flatnonzero(map_.placed[first])
        away_m = np.linalg.norm(paths[first].positions_m[known] - T_world_left[:3, 3], axis=1)
        anchor = int(known[np.argmin(away_m)])
        T = invert(paths[first].T_world_camera[anchor]) @ T_world_left @ T
        anchored = replace(
            loop, first=anchor, last=end, T_first_last=T, information=information, same_frame=False
        )
        links.append(Link((first, other), anchored))
    return links


def _too_old(map_: MapFile, keep: Keep) -> set[int]:
    """Return the numbers of drives that are older than the newest by more than may be."""
    if keep.days is None:
        return set()
    with reading(map_.store.name):
        dates = {one.number: one.date.seconds for one in map_.sessions if one.date.text}
    newest_s = max(dates.values(), default=0.0)
    return {number for number, date_s in dates.items() if newest_s - date_s > keep.days * DAY_S}


class _Seen:
    """What a drive saw in coarse cells.

    ``keys`` are the packed cells (M,), sorted, that it hit something in or looked through, and
    ``keys_m`` from how near; ``ends``, ``ends_m`` the same of those that rays end in, ``frames`` of
    how many frames they do.
    """

    def __init__(self, map_: MapFile, session: Session, settings: DriveSettings) -> None:
        self.session, self.settings = session, settings
        self.placed = map_.placed[session.number]
        self.cell_m = BLOCK_EDGE / 2 * settings.occupancy.resolution_m
        self.T_map_camera = session.T_map_world @ session.trajectory.T_world_camera
        self.rays = 0
        passed, ended = _Cells(), _Cells()
        for frame in session.with_rays:
            rays = session.rays(frame)[0]
            self.rays += len(rays)
            if self.placed[frame]:
                ends, at_m = self.ends_of(rays, frame), self._lengths_m(rays)
                ended.add(ends, at_m)
                free, free_m = self._looked_through(rays, frame)
                passed.add(np.concatenate([ends, free]), np.concatenate([at_m, free_m]))
        self.keys, self.keys_m, _ = passed.joined()
        self.ends, self.ends_m, self.frames = ended.joined()

    def cells(self, places_m: Float64) -> Int64:
        """Return packed cells (N,) of places (N, 3) in map axes."""
        return pack_keys(np.floor(places_m / self.cell_m).astype(np.int64))

    def ends_of(self, rays: RayCloud, frame: int) -> Int64:
        """Return packed cells (N,) in which rays end, or go out of range."""
        xyz = rays.cloud().xyz.astype(np.float64)
        xyz *= (self._lengths_m(rays) / np.linalg.norm(xyz, axis=1))[:, None]
        return self.cells(apply(self.T_map_camera[frame], xyz))

    def _lengths_m(self, rays: RayCloud) -> Float64:
        length_m = np.linalg.norm(rays.cloud().xyz.astype(np.float64), axis=1)
        return np.asarray(np.minimum(length_m, self.settings.occupancy.max_range_m))

    def _looked_through(self, rays: RayCloud, frame: int) -> tuple[Int64, Float64]:
        """Return the cells that some rays pass, and how far along each."""
        xyz, step_m = rays.cloud().xyz.astype(np.float64), self.cell_m / _STEPS
        # Of rays that end in one cell, one says what they pass.
        rows = np.unique(self.cells(xyz), return_index=True)[1]
        free_m = self._lengths_m(rays)[rows] - FREE_MARGIN_SIGMAS * rays.sigma_m[rows]
        at_m = np.arange(0.5 * step_m, self.settings.occupancy.max_range_m, step_m)
        ray, step = np.nonzero(at_m < free_m[:, None])
        ways = xyz[rows] / np.linalg.norm(xyz[rows], axis=1)[:, None]
        places_m = apply(self.T_map_camera[frame], at_m[step][:, None] * ways[ray])
        return self.cells(places_m), at_m[step]

    def not_confirmed(self, newer: Sequence[_Seen], drives: int) -> Int64 | None:
        """Return the cells that rays end in and newer drives did not see as well; None = all."""
        if len(newer) < drives:
            return None
        # Within a cell, nobody knows how far away something is.
        most_m = np.asarray(_AS_FAR * np.maximum(self.ends_m, self.cell_m))
        count = np.zeros(len(self.ends))
        for other in newer:
            place, known = find_keys(self.ends, other.keys)
            count[known] += other.keys_m[place[known]] <= most_m[known]
        left = (count < drives) & (self.frames >= self.settings.fusion.min_count)
        if len(newer) >= _LOOKS * drives:
            centres_m = (unpack_keys(self.ends[left]) + 0.5) * self.cell_m
            looks = [other.towards(centres_m, most_m[left]) for other in newer]
            left[left] = np.sum(looks, axis=0) < _LOOKS * drives
        return self.ends[left]

    def towards(self, places_m: NDArray[Any], most_m: NDArray[Any]) -> Bool:
        """Return bool (N,), which places the drive had in view from no more than so far."""
        found, camera = np.zeros(len(places_m), np.bool_), self.session.camera
        for T in self.T_map_camera[self.placed]:
            rows = np.flatnonzero(np.linalg.norm(places_m - T[:3, 3], axis=1) <= most_m)
            u, v, _ = project(apply(invert(T), places_m[rows]), camera)
            with np.errstate(invalid="ignore"):
                inside = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
            found[rows[inside]] = True
        return found


class _Cells:
    """Cells that frames saw, the least length of a ray to each, and of how many frames it was."""

    def __init__(self) -> None:
        self._parts = [(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))]

    def add(self, keys: Int64, lengths_m: Float64) -> None:
        """Add what one frame saw: packed cells (N,), each any number of times."""
        order = np.argsort(lengths_m, kind="stable")
        found, first = np.unique(keys[order], return_index=True)
        self._parts.append((found, lengths_m[order][first], np.ones(len(found), np.int64)))
        if sum(len(part[0]) for part in self._parts[1:]) > _MOST_ROWS:
            self._parts = [self.joined()]

    def joined(self) -> tuple[Int64, Float64, Int64]:
        """Return each cell once, sorted, with its least length and its number of frames."""
        keys, lengths_m, frames = map(np.concatenate, zip(*self._parts, strict=True))
        found, row = np.unique(keys, return_inverse=True)
        least_m = np.full(len(found), np.inf)
        np.minimum.at(least_m, row, lengths_m)
        return found, least_m, np.bincount(row, frames, len(found)).astype(np.int64)


def _thin(seen: _Seen, cells: Int64 | None, keep: Keep, views: Collection[int]) -> Thinned:
    """Keep what of a drive is in cells (None = in all) and the region; return what is left."""
    session, empty, left = seen.session, list[int](), seen.rays
    for frame in views:
        session.keyframes.drop(frame)
    keyframes = len(session.keyframes.frames)
    whole = Thinned(seen.rays, seen.rays, keyframes + len(views), keyframes + len(views))
    if cells is not None or keep.region is not None:
        left = 0
        for frame in session.with_rays:
            rays, grain = session.rays(frame)
            places_m = apply(seen.T_map_camera[frame], rays.cloud().xyz.astype(np.float64))
            kept = ~keep.outside(places_m)
            if cells is not None:
                kept &= seen.placed[frame] & are_among(seen.ends_of(rays, frame), cells)
            if not kept.all():
                session.add_rays(frame, rays.select(kept), grain)
            left += int(kept.sum())
            empty += [] if kept.any() else [frame]
        _thin_submaps(seen, cells, keep)
    before = session.thinned or whole
    found = replace(before, rays=left, keyframes=keyframes, empty=(*before.empty, *empty))
    if found != before:
        session.set_thinned(found)
    return found


def _thin_submaps(seen: _Seen, cells: Int64 | None, keep: Keep) -> None:
    """Keep the voxels of a drive in cells and the region; occupancy is made of rays again."""
    session, fusion = seen.session, seen.settings.fusion
    corrections = session.corrections()
    for number, submap in enumerate(session.submaps):
        T = session.T_map_world
        if corrections is not None:
            T = T @ corrections[number]
        places_m = apply(T, submap.fused.points(fusion.voxel_m))
        kept = ~keep.outside(places_m)
        if cells is not None:
            kept &= submap.fused.enough(fusion.min_count, fusion.voxel_m)
            kept &= are_among(seen.cells(places_m), cells)
        if not kept.all() or len(submap.occupancy):
            nothing = submap.occupancy.select(np.zeros(len(submap.occupancy.blocks), np.bool_))
            fused = submap.fused.select(np.flatnonzero(kept))
            session.submaps.add(replace(submap, fused=fused, occupancy=nothing), compress=True)


def _views_to_drop(map_: MapFile, keep: Keep) -> dict[int, set[int]]:
    """Return the frames of keyframes, by drive, that newer drives recognise or that lie outside."""
    old, found = _too_old(map_, keep), dict[int, set[int]]()
    for session in map_.linked:
        places_m = apply(session.T_map_world, session.trajectory.positions_m)
        out = keep.outside(places_m) | (session.number in old)
        found[session.number] = {frame for frame in session.keyframes.frames if out[frame]}
    if keep.drives is None:
        return found
    views = MapViews(map_)
    known, numbers = KnownPlaces(views, map_.first.scale), [one.number for one in map_.linked]
    left = np.array([frame not in found[drive] for drive, frame in views.keys])
    older = [n for n, (drive, _) in enumerate(views.keys) if drive not in numbers[-keep.drives :]]
    for view in tracked(older[::-1], "keyframes", "compare looks"):
        drive, frame = views.keys[view]
        near = known.near(views[view].T_world_camera, len(views)) if left[view] else ()
        newer: dict[int, list[int]] = {}
        for n in near:
            if left[n] and views.keys[n][0] > drive:
                newer.setdefault(views.keys[n][0], []).append(n)
        if len(newer) >= keep.drives and _is_known(known, views, view, newer, keep.drives):
            left[view] = False
            found[drive].add(frame)
    return found


def _is_known(
    known: KnownPlaces, views: MapViews, view: int, newer: dict[int, list[int]], drives: int
) -> bool:
    """Return whether newer drives, of each the views near one, make it superfluous."""
    if len(newer) >= _LOOKS * drives:
        return True
    own, confirmed = views[view], 0
    for behind, drive in enumerate(sorted(newer, reverse=True), 1):
        theirs = newer[drive][:_NEAREST]
        confirmed += any(known.compare(n, own.keyframe, own.camera).loop for n in theirs)
        if confirmed >= drives or confirmed + len(newer) - behind < drives:
            break
    return confirmed >= drives
