"""The drives of a map in their places, cut into tiles: what products are made of.

By several processes, which share files: first each cuts some submaps into tiles, into a file of its
own; then each makes voxels and points of some tiles from all these files, into another one. What
comes of it is what one process makes: parts are numbered by submap, and joined in that order.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError, MappingError, SettingsError
from recon.core.geometry.se3 import apply, invert
from recon.core.progress import tracked
from recon.core.values import RayCloud
from recon.core.values.arrays import Bool, Float64
from recon.core.work import side_by_side
from recon.io.files import resolved
from recon.map.builders import OccupancyBuilder, Submap
from recon.map.cut import Cutter, TileKey, TileParts
from recon.map.fusion import join_fused
from recon.map.occupancy.bodies import FrameObservations
from recon.map.occupancy.part import join_occupancy
from recon.map.sessions.joining import seen_before
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile
from recon.map.store.records import Store
from recon.map.store.session import Session, Submaps
from recon.map.tiles import Tiles

Each = Callable[[Callable[[Any], None], Sequence[Any]], None]
"""Calls a function with each of several values, somewhere, and waits until all are done."""
_SHARE: Final = 4  # tasks for each process, so that none waits long for another


@dataclass(frozen=True, eq=False)
class PlacedMap:
    """What the drives of a map that share its axes observed, in tiles."""

    tiles: Tiles
    # float64 (N, 3), positions of the camera, or as high above the base of its robot if that is
    # known, map axes; a row of NaN between two drives
    path_m: Float64
    trusted: Bool  # (N,), which of them are to be trusted, and have a place in the map


def settings_of(session: Session) -> DriveSettings:
    """Return the settings that a drive was mapped with."""
    known = DriveSettings.model_fields
    config = {name: part for name, part in session.info.config.items() if name in known}
    return DriveSettings.parse(config, where=session.where)


def place_map(
    map_: MapFile,
    settings: DriveSettings,
    threads: int = 1,
    *,
    only: Collection[int] | None = None,
) -> PlacedMap:
    """Cut the linked drives of a map into tiles, with the settings of its products.

    ``only`` are numbers of submaps, of a map that is being made: the others are left out, and the
    path of their frames is NaN.

    Occupancy that the drive kept is taken where it was made with these settings; else it is made
    from its rays, of so many submaps at a time. A map without rays has a cloud, and no occupancy.
    """
    placed = PlacedSubmaps(map_, settings)
    submaps: Iterable[Submap] = placed if only is None else placed.only(only)
    if not placed.ready and only is None:
        submaps = placed.made(threads)
    tiles = Tiles.of_submaps(
        submaps,
        settings,
        map_.first.T_map_world,
        placed.corrections,
        drives=placed.drives,
    )
    whole = _with_path(map_, settings, tiles)
    if only is None:
        return whole
    used = np.isin(tiles.submap_of_frame, [*only])
    path_m = np.where(used[:, None], whole.path_m[: len(used)], np.nan)
    return PlacedMap(tiles, path_m, whole.trusted[: len(used)] & used)


def place_map_on(
    map_: MapFile, settings: DriveSettings, folder: Path, each: Each, workers: int
) -> PlacedMap:
    """Do what `place_map` does, and make all tiles, on so many processes.

    The map is in a file, and the folder one that all processes see; what they leave there is read
    as long as the tiles are used.
    """
    if map_.store.path is None:
        raise MappingError("other processes cannot read a temporary map")
    file = resolved(map_.store.path)
    placed, halvings, tiles = PlacedSubmaps(map_, settings), -1, None
    folder.mkdir(parents=True, exist_ok=True)
    while tiles is None:
        halvings += 1
        batches = _batches(range(len(placed)), workers)
        parts = [folder / f"submaps-{halvings}-{n}" for n in range(len(batches))]
        each(partial(_cut_submaps, file, settings, halvings), [*zip(batches, parts, strict=True)])
        axes, drives = map_.first.T_map_world, placed.drives
        taken = partial(Tiles.of_files, parts, settings, axes, halvings=halvings, drives=drives)
        tiles = taken()
    groups = _batches([tile.key for tile in tiles], workers)
    files = [folder / f"tiles-{n}" for n in range(len(groups))]
    each(partial(_make_tiles, file, settings, taken), [*zip(groups, files, strict=True)])
    tiles.adopt(files)
    return _with_path(map_, settings, tiles)


class PlacedSubmaps:
    """The submaps of all linked drives of a map, one drive after the other, where they lie.

    Those of a single drive are in its world by odometry, to be corrected; those of several are in
    the world of the first: sums are moved, rays cast where they were seen. Frames without a place
    in the map give none, and their submaps, in which frames cannot be told apart, no sums.

    ``drives`` are the numbers of submaps of each, ``corrections`` (S, 4, 4) what is still to be
    applied to each (None = nothing); they are ``ready`` where no ray is to be cast.
    """

    def __init__(self, map_: MapFile, settings: DriveSettings) -> None:
        sessions = map_.linked
        alone = len(sessions) == 1
        self.ready = alone and not _to_be_cast(sessions[0], settings)
        for session in [] if self.ready else sessions:
            check_rays(session, settings)
        self._settings = settings
        self._entries = sessions[0].submaps.entries if alone else ()
        self._apart = [_without_place(map_, session) for session in sessions]
        self.drives = [len(session.submaps) for session in sessions]
        self.corrections = sessions[0].corrections() if alone else None
        self._batches = (
            [(sessions[0].submaps if self.ready else CastSubmaps(sessions[0], settings), None)]
            if alone
            else [_beside(map_, session, settings) for session in sessions]
        )

    def __len__(self) -> int:
        return sum(self.drives)

    def __iter__(self) -> Iterator[Submap]:
        return map(self.__getitem__, range(len(self)))

    def made(self, threads: int) -> Submaps:
        """Make all, once, into a temporary store: they may be cut several times, and are slow."""
        made = Submaps(Store.temporary(cache_bytes=self._settings.memory.cache_bytes))
        cast = side_by_side(self.__getitem__, range(len(self)), threads=threads)
        for submap in tracked(cast, "submaps", "cast rays", total=len(self)):
            made.add(replace(submap, index=len(made), first_frame=made.frames))
        return made

    def only(self, numbers: Collection[int]) -> Iterator[Submap]:
        """Yield all submaps of an only drive, but those of other numbers empty, and not read."""
        nothing = join_fused(()), join_occupancy(())
        for n, entry in enumerate(self._entries):
            frames = entry.first_frame, entry.frames
            yield self[n] if n in numbers else Submap(n, *frames, *nothing)

    def __getitem__(self, number: int) -> Submap:
        """Return a submap by its number among those of all drives."""
        drive = int(np.searchsorted(np.cumsum(self.drives), number, side="right"))
        own = number - sum(self.drives[:drive])
        submaps, T = self._batches[drive]
        submap = submaps[own]
        frames = range(submap.first_frame, submap.first_frame + submap.frames)
        if not self._apart[drive].isdisjoint(frames):
            nothing = np.zeros(len(submap.occupancy.blocks), np.bool_)
            seen = submap.occupancy.select(nothing) if len(self.drives) == 1 else submap.occupancy
            return replace(submap, fused=submap.fused.select(np.zeros(0, np.intp)), occupancy=seen)
        if T is None or np.array_equal(T[own], np.eye(4)):
            return submap
        return replace(submap, fused=submap.fused.moved(T[own], self._settings.fusion.voxel_m))


def has_occupancy(map_: MapFile) -> bool:
    """Return whether a map knows what is free, or can find it out from its rays."""
    first = map_.first
    return first.ray_frames > 0 or any(entry.cells for entry in first.submaps.entries)


def _to_be_cast(session: Session, settings: DriveSettings) -> bool:
    """Return whether an only drive's occupancy was not kept, or made with other settings."""
    if not any(entry.cells for entry in session.submaps.entries):
        return session.ray_frames > 0
    made, wanted = settings_of(session).occupancy, settings.occupancy
    return made.model_copy(update={"keep_rays": wanted.keep_rays}) != wanted


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


def observations_of(
    map_: MapFile, settings: DriveSettings, sessions: Sequence[Session] | None = None
) -> FrameObservations | None:
    """Return what frames saw, by their rays; None where a drive kept none.

    Those of some linked drives, in that order; None = of all.
    """
    seen: list[tuple[Session, int]] = []
    poses = []
    for session in map_.linked if sessions is None else sessions:
        if session.ray_frames != len(session):
            return None
        T_map_camera, without = session.trajectory.T_world_camera, _no_evidence(map_, session)
        frames = [frame for frame in range(len(session)) if frame not in without]
        seen += [(session, frame) for frame in frames]
        poses.append((session.T_map_world @ T_map_camera)[frames])

    def rays(number: int) -> RayCloud:
        session, frame = seen[number]
        return session.rays(frame)[0]

    names = [(session.number, frame) for session, frame in seen]
    cameras = [session.camera for session, _ in seen]
    return FrameObservations(settings.occupancy, np.concatenate(poses), rays, names, cameras)


def _no_evidence(map_: MapFile, session: Session) -> frozenset[int]:
    """Return the frames without rays or a place, and those whose images an earlier drive has."""
    thinned = session.thinned
    empty = frozenset(() if thinned is None else thinned.empty)
    return seen_before(map_, session) | _without_place(map_, session) | empty


def _without_place(map_: MapFile, session: Session) -> frozenset[int]:
    """Return the frames of a drive that saw something, but have no place in the map."""
    frames = np.flatnonzero(session.trusted & ~map_.placed[session.number])
    return frozenset(frames.tolist())


def _with_path(map_: MapFile, settings: DriveSettings, tiles: Tiles) -> PlacedMap:
    """Return the tiles of a map with what its frames saw, and the paths of its linked drives."""
    tiles.observations = observations_of(map_, settings)
    paths, good, placed = list[Float64](), list[Bool](), map_.placed
    for session in map_.linked:
        if paths:  # a row between two drives
            paths.append(np.full((1, 3), np.nan))
            good.append(np.zeros(1, np.bool_))
        path, mount = session.trajectory, session.mount
        paths.append(apply(session.T_map_world, path.positions_m))
        if mount is not None:
            T = session.T_map_world @ path.T_world_camera @ invert(mount.T_base_camera)
            paths[-1] = T[:, :3, 3] + mount.T_base_camera[2, 3] * T[:, :3, 2]
        good.append(placed[session.number])
    return PlacedMap(tiles, np.concatenate(paths), np.concatenate(good))


def _batches(items: Sequence[Any], workers: int) -> list[Any]:
    """Return items in fractions of neighbours, several for each process."""
    count = max(1, min(len(items), _SHARE * workers))
    ends = [len(items) * n // count for n in range(count + 1)]
    return [items[a:b] for a, b in pairwise(ends)]


def _cut_submaps(
    map_file: Path, settings: DriveSettings, halvings: int, task: tuple[range, Path]
) -> None:
    """Cut some submaps of a map into tiles, in a file."""
    numbers, file = task
    with MapFile.open(map_file) as map_:
        placed = PlacedSubmaps(map_, settings)
        T = placed.corrections
        cutter = Cutter(settings, map_.first.T_map_world, halvings)
        parts = TileParts(cutter.edge_m, file)
        cut = cutter.cut(
            (placed[number] for number in numbers),
            parts,
            None if T is None else T[numbers.start : numbers.stop],
            first=numbers.start,
        )
        parts.save(cut.to_tree())


def _make_tiles(
    map_file: Path,
    settings: DriveSettings,
    taken: Callable[..., Any],
    task: tuple[Sequence[TileKey], Path],
) -> None:
    """Make the voxels and points of some tiles, and find the floors in them, in a file."""
    keys, file = task
    tiles = taken(path=file)
    with MapFile.open(map_file) as map_:
        tiles.observations = observations_of(map_, settings)
        for key in keys:
            tiles.make_voxels(key)
            tiles.cloud(key)
    tiles.save()


@dataclass(frozen=True, eq=False)
class CastSubmaps:
    """The submaps of a drive, each with occupancy made from its rays when it is read.

    ``T_map_world`` is from world to the axes of the occupancy (None = its own); ``T_world_camera``,
    float64 (N, 4, 4), from where rays are cast (None = the path by odometry); rays of the frames
    ``without`` are not cast.
    """

    session: Session
    settings: DriveSettings
    T_map_world: Float64 | None = None
    T_world_camera: Float64 | None = None
    without: Collection[int] = ()

    def __post_init__(self) -> None:
        if self.session.submaps.frames != len(self.session):
            raise FormatError("the map lacks submaps", where=self.session.where)

    def __len__(self) -> int:
        return len(self.session.submaps)

    def __getitem__(self, number: int) -> Submap:
        session, kept = self.session, self.session.submaps[number]
        T_map_world = session.T_map_world if self.T_map_world is None else self.T_map_world
        poses = self.T_world_camera
        poses = session.odometry.T_world_camera if poses is None else poses
        builder = OccupancyBuilder(self.settings.occupancy, T_map_world)
        for frame in range(kept.first_frame, kept.first_frame + kept.frames):
            if frame not in self.without:
                builder.integrate(session.rays(frame)[0].cloud(), poses[frame])
        return replace(kept, occupancy=builder.take())


def check_rays(session: Session, settings: DriveSettings) -> None:
    """Refuse a cell size or range that the kept rays of a session do not support."""
    if not session.ray_frames:
        raise FormatError(
            "the run kept no rays to build occupancy from",
            where=session.where,
            hint="map the drive again with --set occupancy.keep_rays=true",
        )
    if session.ray_frames != len(session):
        raise FormatError(
            "the run has different numbers of ray frames and poses",
            where=session.where,
            got=f"{session.ray_frames} and {len(session)}",
        )
    grain, wanted = session.rays(0)[1], settings.occupancy
    # The 0.05 % tolerance is for rounded input, such as 0.3333 for a third.
    if wanted.resolution_m < grain.cell_m * 0.9995:
        raise SettingsError(
            "the rays kept by the run are too coarse for these voxels",
            got=f"{wanted.resolution_m:g} m",
            expected=f"at least {grain.cell_m:g} m",
            hint="map the drive again with a smaller --set occupancy.resolution_m=",
        )
    if wanted.max_range_m > grain.max_range_m * (1 + 1e-9):
        raise SettingsError(
            "the rays kept by the run do not reach that far",
            got=f"{wanted.max_range_m:g} m",
            expected=f"at most {grain.max_range_m:g} m",
            hint="map the drive again with --set occupancy.max_range_m=",
        )
