"""The drives of a map in their places, cut into tiles: what products are made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.values.arrays import Bool, Float64
from recon.map.settings import DriveSettings
from recon.map.store.finished import check_rays, with_occupancy
from recon.map.store.map import Map
from recon.map.store.records import Store
from recon.map.store.session import Session
from recon.map.store.submaps import Submaps
from recon.map.submaps import Submap
from recon.map.tiles import Tiles


@dataclass(frozen=True, eq=False)
class PlacedMap:
    """The drives of a map that share its axes.

    Attributes:
        tiles: What they observed.
        path_m: float64 (N, 3), positions of the camera, map axes; a row of NaN between two drives.
        trusted: bool (N,), which of them are to be trusted.
    """

    tiles: Tiles
    path_m: Float64
    trusted: Bool


def settings_of(session: Session) -> DriveSettings:
    """Return the settings that a drive was mapped with.

    Raises:
        SettingsError: One is not known in this version.
    """
    known = DriveSettings.model_fields
    config = {name: part for name, part in session.info.config.items() if name in known}
    return DriveSettings.parse(config, where=session.where)


def place_map(map_: Map, settings: DriveSettings, *, fuse: bool = True) -> PlacedMap:
    """Cut the linked drives of a finished map into tiles, with occupancy made from their rays.

    Args:
        map_: The map.
        settings: The settings of its products.
        fuse: Make the cloud; else it is put into the tiles as it was written.

    Raises:
        FormatError: A drive kept no rays, or the map is damaged.
        SettingsError: The settings need finer or longer rays than were kept.
        OutputError: There is no room for the tiles.
    """
    sessions = map_.linked
    for session in sessions:
        check_rays(session, settings)
    T_map_world = map_.first.T_map_world
    if len(sessions) == 1:
        submaps, corrections = with_occupancy(sessions[0], settings), sessions[0].corrections()
    else:
        submaps, corrections = _joined(map_, sessions, settings), None
    drives = [len(session.submaps) for session in sessions]
    tiles = Tiles.of_submaps(submaps, settings, T_map_world, corrections, drives=drives, fuse=fuse)
    paths = [apply(s.T_map_world, s.trajectory.positions_m) for s in sessions]
    good = [np.array([health.ok for health in session.health]) for session in sessions]
    return PlacedMap(tiles, _with_gaps(paths, np.nan), _with_gaps(good, False))


def _joined(map_: Map, sessions: Sequence[Session], settings: DriveSettings) -> Submaps:
    """Return the submaps of several drives one after the other, in the world of the first."""
    made = Submaps(Store.temporary(cache_bytes=settings.memory.cache_bytes))
    for session in sessions:
        for submap in _moved(map_, session, settings):
            made.add(replace(submap, index=len(made), first_frame=made.frames))
    return made


def _moved(map_: Map, session: Session, settings: DriveSettings) -> Iterator[Submap]:
    """Put the submaps of a drive in its place: sums are moved, rays cast where they were seen."""
    T_world_session, corrections = map_.T_world_session(session), session.corrections()
    T_map_world = map_.first.T_map_world
    poses = T_world_session @ session.trajectory.T_world_camera
    for number, submap in enumerate(with_occupancy(session, settings, T_map_world, poses)):
        T = T_world_session if corrections is None else T_world_session @ corrections[number]
        still = np.array_equal(T, np.eye(4))
        fused = submap.fused if still else submap.fused.moved(T, settings.fusion.voxel_m)
        yield replace(submap, fused=fused)


def _with_gaps(parts: Sequence[np.ndarray], gap: float) -> np.ndarray:
    """Return rows of several drives, with a row in between."""
    rows = [parts[0]]
    for part in parts[1:]:
        rows += [np.full_like(part[:1], gap), part]
    return np.concatenate(rows)
