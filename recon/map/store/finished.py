"""What a finished map keeps: rays exactly, fused sums rounded, nothing that resuming needs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, SettingsError
from recon.core.kernels import voxels
from recon.core.values.arrays import Bool, Float32, Float64, Int32
from recon.map.kernels import clamped
from recon.map.occupancy.builder import OccupancyBuilder
from recon.map.occupancy.part import OccupancyPart
from recon.map.settings import DriveSettings
from recon.map.store.keyframes import KEYFRAME
from recon.map.store.map import Map
from recon.map.store.records import Store
from recon.map.store.session import AXES, LOOPS, RAYS, Session
from recon.map.store.submaps import Submaps
from recon.map.submaps import Submap
from recon.run.lookahead import side_by_side

_PLACED: Final = slice(0, 4)
_PLACE_BITS: Final = 12
"""Of weights and offsets: the mean of a voxel of 0.1 m moves by some µm at most."""
_VALUE_BITS: Final = 8
"""Of colours, normals and the rest: half a level of 255, a tenth of a degree."""
_INFORMATION_BITS: Final = 16
"""It decides which voxels are precise enough to be exported."""


def keep_map(mapped: Map, path: Path, settings: DriveSettings) -> None:
    """Write the map of finished drives: path, rays, keyframes, loops, and compact submaps.

    The fused sums are rounded, and lack voxels that too few frames saw to be exported; occupancy is
    left out, since `with_occupancy` makes it from the rays again.

    Args:
        mapped: The map as it was made.
        path: The new file.
        settings: What decides which voxels are exported.

    Raises:
        OutputError: The file cannot be written.
    """
    with Map.create(path) as kept:
        for session in mapped.sessions:
            new = kept.begin(replace(session.info, start={}))
            for number, T_world_camera in enumerate(session.odometry.T_world_camera):
                time_s = float(session.odometry.timestamps_s[number])
                new.add_frame(T_world_camera, time_s, session.health[number])
            where = _Places(session, settings.fusion.voxel_m)
            least = min(settings.fusion.min_count, len(session)) - 1  # where a voxel is precise
            for index in range(len(session.submaps)):
                new.submaps.add(_compact(session.submaps.get(index), least, where), compress=True)
        for kind in (AXES, LOOPS, KEYFRAME, RAYS):
            mapped.store.copy(kind, kept.store)
        kept.commit()


@dataclass(frozen=True, eq=False)
class CastSubmaps:
    """The submaps of a finished drive, each with occupancy made from its rays when it is read.

    Attributes:
        session: The drive.
        settings: How to make it.
        T_map_world: float64 (4, 4), from world to the axes of the occupancy; None = its own.
        T_world_camera: float64 (N, 4, 4), from where rays are cast; None = the path by odometry.
        without: Frames whose rays are not cast.
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
        """Return a submap.

        Raises:
            FormatError: The map is damaged.
            MappingError: A ray would spoil the map.
        """
        session, kept = self.session, self.session.submaps.get(number)
        T_map_world = session.T_map_world if self.T_map_world is None else self.T_map_world
        poses = self.T_world_camera
        poses = session.odometry.T_world_camera if poses is None else poses
        builder = OccupancyBuilder(self.settings.occupancy, T_map_world)
        for frame in range(kept.first_frame, kept.first_frame + kept.frames):
            if frame not in self.without:
                builder.integrate(session.rays(frame)[0].cloud(), poses[frame])
        return replace(kept, occupancy=builder.take())


def with_occupancy(session: Session, settings: DriveSettings, *, threads: int = 1) -> Submaps:
    """Return the submaps of a finished drive in a temporary store, with occupancy from its rays.

    Args:
        session: The drive.
        settings: How to make it.
        threads: Submaps made at a time. Changes no result.

    Raises:
        FormatError: The map is damaged.
        MappingError: A ray would spoil the map.
    """
    made = Submaps(Store.temporary(cache_bytes=settings.memory.cache_bytes))
    cast = CastSubmaps(session, settings)
    read, numbers = cast.__getitem__, range(len(cast))
    for submap in (
        map(read, numbers) if threads == 1 else side_by_side(read, numbers, threads=threads)
    ):
        made.add(submap)
    return made


def check_rays(session: Session, settings: DriveSettings) -> None:
    """Refuse a cell size or range that the kept rays of a session do not support.

    Raises:
        FormatError: It kept no rays, or is damaged.
        SettingsError: The settings need finer or longer rays than it kept.
    """
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
            hint="map the drive again with --set occupancy.rays_per_voxel= or resolution_m=",
        )
    if wanted.max_range_m > grain.max_range_m * (1 + 1e-9):
        raise SettingsError(
            "the rays kept by the run do not reach that far",
            got=f"{wanted.max_range_m:g} m",
            expected=f"at most {grain.max_range_m:g} m",
            hint="map the drive again with --set occupancy.max_range_m=",
        )


def _compact(submap: Submap, least: int, where: _Places) -> Submap:
    """Return a submap as kept: without voxels that too few frames saw and no submap adds to.

    The caller names no submap, so that one at a time is in memory.
    """
    few = submap.fused.frames < least
    fused = submap.fused.select(~few | where.shared(submap.index))
    sums = fused.sums
    sums[:, _PLACED] = _rounded(sums[:, _PLACED], _PLACE_BITS)
    sums[:, _PLACED.stop :] = _rounded(sums[:, _PLACED.stop :], _VALUE_BITS)
    information = _rounded(fused.information, _INFORMATION_BITS)
    fused = replace(fused, sums=sums, information=information)
    return replace(submap, fused=fused, occupancy=_nothing())


class _Places:
    """Where the voxels of the submaps of a session are after loop closure."""

    def __init__(self, session: Session, voxel_m: float) -> None:
        self._submaps, self._voxel_m = session.submaps, voxel_m
        self._corrections = session.corrections()
        self._boxes = [self._box(index) for index in range(len(self._submaps))]

    def shared(self, index: int) -> Bool:
        """Return which voxels share their place with one of another submap or, moved, their own."""
        keys = self._keys(index)
        _, where, counts = np.unique(keys, return_inverse=True, return_counts=True)
        found = counts[where] > 1
        for other, (low, high) in enumerate(self._boxes):
            ours_low, ours_high = self._boxes[index]
            if other != index and (low <= ours_high).all() and (ours_low <= high).all():
                found |= np.isin(keys, self._keys(other))
        return found

    def _keys(self, index: int) -> NDArray[np.int64]:
        """Return int64 (N,), packed cell of each voxel of a submap."""
        return self._submaps.store.cache.get(
            ("moved keys", id(self), index), lambda: self._moved(index)
        )

    def _moved(self, index: int) -> NDArray[np.int64]:
        fused = self._submaps.get(index).fused
        if self._corrections is None or np.array_equal(self._corrections[index], np.eye(4)):
            return fused.keys
        return fused.moved_keys(self._corrections[index], self._voxel_m)

    def _box(self, index: int) -> tuple[Int32, Int32]:
        """Return the smallest and the largest cell of a submap."""
        cells = voxels.unpack_keys(self._keys(index))
        nowhere = np.full(3, np.iinfo(np.int32).max)
        if not len(cells):
            return nowhere, -nowhere
        return cells.min(axis=0), cells.max(axis=0)


def _rounded(values: Float32, bits: int) -> Float32:
    """Return numbers with fewer bits behind the point of their mantissa; the rest is zero."""
    drop = 23 - bits
    half = np.int32(1 << (drop - 1))
    whole = np.ascontiguousarray(values).view(np.int32) + half
    return np.asarray((whole >> drop << drop).view(np.float32))


def _nothing() -> OccupancyPart:
    """Return occupancy without a cell."""
    blocks, starts, cells = np.zeros(0, np.int64), np.zeros(1, np.int64), np.zeros(0, np.uint16)
    return OccupancyPart(clamped.CellRows(blocks, starts, cells, np.zeros((0, 3), np.float32)))
