"""What a finished map keeps: all that its products are made from, nothing for resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from recon.map.kernels import clamped
from recon.map.occupancy.part import OccupancyPart
from recon.map.store.keyframes import KEYFRAME
from recon.map.store.map_file import MapFile
from recon.map.store.rays import RAYS
from recon.map.store.session import AXES, LOOPS


def keep_map(mapped: MapFile, path: Path) -> None:
    """Write the map of finished drives: path, rays, keyframes, loops, and fused submaps.

    Occupancy is left out, since `place_map` makes it from the rays again.

    Args:
        mapped: The map as it was made.
        path: The new file.
    """
    with MapFile.create(path) as kept:
        for session in mapped.sessions:
            new = kept.begin(replace(session.info, start={}))
            for number, T_world_camera in enumerate(session.odometry.T_world_camera):
                time_s = float(session.odometry.timestamps_s[number])
                new.add_frame(T_world_camera, time_s, session.health[number])
            for submap in session.submaps:
                new.submaps.add(replace(submap, occupancy=_nothing()), compress=True)
        for kind in (AXES, LOOPS, KEYFRAME, RAYS):
            mapped.store.copy(kind, kept.store)
        kept.commit()


def _nothing() -> OccupancyPart:
    """Return occupancy without a cell."""
    blocks, starts, cells = np.zeros(0, np.int64), np.zeros(1, np.int64), np.zeros(0, np.uint16)
    return OccupancyPart(clamped.CellRows(blocks, starts, cells, np.zeros((0, 3), np.float32)))
