"""What a finished map keeps: rays exactly, fused sums rounded, nothing that resuming needs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels import voxels
from recon.core.keys import are_among
from recon.core.values.arrays import Bool, Float32, Int32
from recon.map.kernels import clamped
from recon.map.occupancy.part import OccupancyPart
from recon.map.settings import DriveSettings
from recon.map.store.keyframes import KEYFRAME
from recon.map.store.map import Map
from recon.map.store.rays import RAYS
from recon.map.store.session import AXES, LOOPS, Session
from recon.map.submaps import Submap

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
                found |= are_among(keys, self._keys(other))
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
