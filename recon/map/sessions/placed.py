"""The drives of a map in their places, cut into tiles: what products are made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply
from recon.core.values.arrays import Bool, Float64
from recon.io.files import resolved
from recon.map.cut import Cutter, TileKey, TileParts
from recon.map.occupancy.bodies import Looks
from recon.map.sessions.joining import seen_before
from recon.map.settings import DriveSettings
from recon.map.store.finished import CastSubmaps, check_rays, looks_of
from recon.map.store.map_file import MapFile
from recon.map.store.records import Store
from recon.map.store.session import Session, Submaps
from recon.map.submaps import Submap
from recon.map.tiles import Tiles
from recon.run.threads import side_by_side


@dataclass(frozen=True, eq=False)
class PlacedMap:
    """The drives of a map that share its axes.

    Attributes:
        tiles: What they observed.
        path_m: float64 (N, 3), positions of the camera, map axes; a row of NaN between two drives.
        trusted: bool (N,), which of them are to be trusted, and have a place in the map.
    """

    tiles: Tiles
    path_m: Float64
    trusted: Bool


def settings_of(session: Session) -> DriveSettings:
    """Return the settings that a drive was mapped with."""
    known = DriveSettings.model_fields
    config = {name: part for name, part in session.info.config.items() if name in known}
    return DriveSettings.parse(config, where=session.where)


def place_map(map_: MapFile, settings: DriveSettings, threads: int = 1) -> PlacedMap:
    """Cut the linked drives of a map into tiles.

    Occupancy that the drive kept is taken where it was made with these settings; else it is made
    from its rays. A map without rays has a cloud, and no occupancy.

    Args:
        map_: The map.
        settings: The settings of its products.
        threads: Submaps whose rays are cast at a time. Changes no result.
    """
    placed = PlacedSubmaps(map_, settings)
    tiles = Tiles.of_submaps(
        placed if placed.ready else _made_once(placed, settings, threads),
        settings,
        map_.first.T_map_world,
        placed.corrections,
        drives=placed.drives,
    )
    return with_path(map_, tiles.with_looks(looks_in(map_, settings)))


class PlacedSubmaps:
    """The submaps of all linked drives of a map, one drive after the other, where they lie.

    Those of a single drive are in its world by odometry, to be corrected; those of several are in
    the world of the first: sums are moved, rays cast where they were seen. Frames without a place
    in the map give none, and their submaps, in which frames cannot be told apart, no sums.

    Args:
        map_: The map.
        settings: How occupancy is made.

    Attributes:
        drives: Number of submaps of each drive.
        corrections: float64 (S, 4, 4), what is still to be applied to each; None = nothing.
        ready: Whether they are read as they are, without a ray being cast.
    """

    def __init__(self, map_: MapFile, settings: DriveSettings) -> None:
        sessions = map_.linked
        self.ready = len(sessions) == 1 and not _to_be_cast(sessions[0], settings)
        for session in [] if self.ready else sessions:
            check_rays(session, settings)
        self._settings = settings
        self._apart = [_without_place(map_, session) for session in sessions]
        self.drives = [len(session.submaps) for session in sessions]
        alone = len(sessions) == 1
        self.corrections = sessions[0].corrections() if alone else None
        self._parts = (
            [(sessions[0].submaps if self.ready else CastSubmaps(sessions[0], settings), None)]
            if alone
            else [_beside(map_, session, settings) for session in sessions]
        )

    def __len__(self) -> int:
        return sum(self.drives)

    def __iter__(self) -> Iterator[Submap]:
        """Return the submaps in order, read one at a time."""
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, number: int) -> Submap:
        """Return a submap by its number among those of all drives."""
        drive = int(np.searchsorted(np.cumsum(self.drives), number, side="right"))
        own = number - sum(self.drives[:drive])
        submaps, T = self._parts[drive]
        submap = submaps[own]
        frames = range(submap.first_frame, submap.first_frame + submap.frames)
        if not self._apart[drive].isdisjoint(frames):
            return replace(submap, fused=submap.fused.select(np.zeros(0, np.intp)))
        if T is None or np.array_equal(T[own], np.eye(4)):
            return submap
        return replace(submap, fused=submap.fused.moved(T[own], self._settings.fusion.voxel_m))


def with_path(map_: MapFile, tiles: Tiles) -> PlacedMap:
    """Return the tiles of a map with the paths of its linked drives."""
    sessions = map_.linked
    paths = [apply(s.T_map_world, s.trajectory.positions_m) for s in sessions]
    placed = map_.placed
    good = [placed[session.number] for session in sessions]
    return PlacedMap(tiles, _with_gaps(paths, np.nan), _with_gaps(good, False))


def has_occupancy(map_: MapFile) -> bool:
    """Return whether a map knows what is free, or can find it out from its rays."""
    first = map_.first
    return first.ray_frames > 0 or any(entry.cells for entry in first.submaps.entries)


def _to_be_cast(session: Session, settings: DriveSettings) -> bool:
    """Return whether the occupancy of the only drive of a map is made from its rays.

    One that is being mapped has that of its own settings; a finished one kept rays alone, if any.
    """
    if not any(entry.cells for entry in session.submaps.entries):
        return session.ray_frames > 0
    made, wanted = settings_of(session).occupancy, settings.occupancy
    return made.model_copy(update={"keep_rays": wanted.keep_rays}) != wanted


def _made_once(placed: PlacedSubmaps, settings: DriveSettings, threads: int) -> Submaps:
    """Return submaps that may be cut several times, and are slow to make, in a temporary store."""
    made = Submaps(Store.temporary(cache_bytes=settings.memory.cache_bytes))
    for submap in side_by_side(placed.__getitem__, range(len(placed)), threads=threads):
        made.add(replace(submap, index=len(made), first_frame=made.frames))
    return made


def _beside(
    map_: MapFile, session: Session, settings: DriveSettings
) -> tuple[CastSubmaps, Float64]:
    """Return the submaps of one of several drives, and what moves the sums of each."""
    T_world_session, corrections = map_.T_world_session(session), session.corrections()
    poses = T_world_session @ session.trajectory.T_world_camera
    T = np.repeat(T_world_session[None], len(session.submaps), axis=0)
    moves = T if corrections is None else T @ corrections
    without = _no_evidence(map_, session)
    return CastSubmaps(session, settings, map_.first.T_map_world, poses, without), moves


def looks_in(map_: MapFile, settings: DriveSettings) -> Looks | None:
    """Return what single frames of the linked drives saw, where they lie; None = not known."""
    return looks_of(
        (
            (s, s.T_map_world @ s.trajectory.T_world_camera, _no_evidence(map_, s))
            for s in map_.linked
        ),
        settings.occupancy,
    )


def _no_evidence(map_: MapFile, session: Session) -> frozenset[int]:
    """Return the frames without a place, and those whose images an earlier drive has, too."""
    return frozenset(seen_before(map_, session) | _without_place(map_, session))


def _without_place(map_: MapFile, session: Session) -> frozenset[int]:
    """Return the frames of a drive that saw something, but have no place in the map."""
    frames = np.flatnonzero(session.trusted & ~map_.placed[session.number])
    return frozenset(frames.tolist())


def _with_gaps(parts: Sequence[np.ndarray], gap: float) -> np.ndarray:
    """Return rows of several drives, with a row in between."""
    rows = [parts[0]]
    for part in parts[1:]:
        rows += [np.full_like(part[:1], gap), part]
    return np.concatenate(rows)


Each = Callable[[Callable[[Any], None], Sequence[Any]], None]
"""Calls a function with each of several values, somewhere, and waits until all are done."""
_SHARE: Final = 4
"""Tasks for each process, so that none waits long for another."""


@dataclass(frozen=True)
class SubmapTask:
    """Submaps to be cut, for a process that can read the map.

    Attributes:
        map: File of the map.
        settings: The settings of its products.
        halvings: How often tiles are halved.
        numbers: The submaps.
        file: Where their parts go.
    """

    map: Path
    settings: DriveSettings
    halvings: int
    numbers: range
    file: Path


@dataclass(frozen=True, eq=False)
class TileTask:
    """Tiles whose content is to be made.

    Attributes:
        map: File of the map.
        parts: Files with what all submaps observed, in order.
        settings: The settings of the products.
        T_map_world: float64 (4, 4).
        halvings: How often tiles are halved.
        drives: Number of submaps of each drive.
        keys: The tiles.
        file: Where their content goes.
    """

    map: Path
    parts: tuple[Path, ...]
    settings: DriveSettings
    T_map_world: Float64
    halvings: int
    drives: tuple[int, ...]
    keys: tuple[TileKey, ...]
    file: Path


def place_map_on(
    map_: MapFile, settings: DriveSettings, folder: Path, each: Each, workers: int
) -> PlacedMap:
    """Do what `place_map` does, and make all tiles, on several processes.

    Args:
        map_: The map, in a file.
        settings: The settings of its products.
        folder: For files that all processes see; they are read as long as the tiles are used.
        each: The processes.
        workers: How many there are.
    """
    if map_.store.path is None:
        raise MappingError("other processes cannot read a temporary map")
    file = resolved(map_.store.path)
    placed, halvings, tiles = PlacedSubmaps(map_, settings), -1, None
    T_map_world, drives = map_.first.T_map_world, tuple(placed.drives)
    folder.mkdir(parents=True, exist_ok=True)
    while tiles is None:
        halvings += 1
        shares = _shares(range(len(placed)), workers)
        parts = tuple(folder / f"submaps-{halvings}-{n}" for n in range(len(shares)))
        each(
            cut_submaps,
            [
                SubmapTask(file, settings, halvings, share, part)
                for share, part in zip(shares, parts, strict=True)
            ],
        )
        tiles = Tiles.of_files(parts, settings, T_map_world, halvings=halvings, drives=drives)
    groups = _shares([tile.key for tile in tiles], workers)
    files = [folder / f"tiles-{n}" for n in range(len(groups))]
    each(
        make_tiles,
        [
            TileTask(file, parts, settings, T_map_world, halvings, drives, tuple(keys), made)
            for keys, made in zip(groups, files, strict=True)
        ],
    )
    tiles.adopt(files)
    return with_path(map_, tiles.with_looks(looks_in(map_, settings)))


def cut_submaps(task: SubmapTask) -> None:
    """Cut some submaps of a map into tiles."""
    with closing(MapFile.open(task.map)) as map_:
        placed = PlacedSubmaps(map_, task.settings)
        T = placed.corrections
        cutter = Cutter(task.settings, map_.first.T_map_world, task.halvings)
        parts = TileParts(cutter.edge_m, task.file)
        cut = cutter.cut(
            (placed[number] for number in task.numbers),
            parts,
            None if T is None else T[task.numbers.start : task.numbers.stop],
            first=task.numbers.start,
        )
        parts.save(cut.to_tree())


def make_tiles(task: TileTask) -> None:
    """Make the voxels and points of some tiles, and find the floors in them."""
    tiles = Tiles.of_files(
        task.parts,
        task.settings,
        task.T_map_world,
        halvings=task.halvings,
        drives=task.drives,
        path=task.file,
    )
    if tiles is not None:  # as known when the task was made
        with closing(MapFile.open(task.map)) as map_:
            tiles.with_looks(looks_in(map_, task.settings))
            for key in task.keys:
                tiles.make_voxels(key)
                tiles.cloud(key)
        tiles.save()


def _shares(items: Sequence[Any], workers: int) -> list[Any]:
    """Return items in shares of neighbours, several for each process."""
    count = max(1, min(len(items), _SHARE * workers))
    ends = [len(items) * n // count for n in range(count + 1)]
    return [items[a:b] for a, b in pairwise(ends)]
