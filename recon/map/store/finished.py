"""What the map of finished drives keeps, and their occupancy made again from the kept rays."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from recon.core.errors import FormatError, SettingsError
from recon.core.values.arrays import Float64
from recon.map.builders import OccupancyBuilder
from recon.map.kernels import clamped
from recon.map.occupancy.part import OccupancyPart
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile
from recon.map.store.session import AXES, IMAGES, KEYFRAME, LOOPS, Session
from recon.map.store.trees import RAYS, RIG
from recon.map.submaps import Submap


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


def keep_map(mapped: MapFile, path: Path) -> None:
    """Write the map of finished drives: path, rays, keyframes, loops, and fused submaps.

    Occupancy is left out, since `place_map` makes it from the rays again.
    """
    with MapFile.create(path) as kept:
        for session in mapped.sessions:
            start = {name: kept_ for name, kept_ in session.info.start.items() if name == IMAGES}
            new = kept.begin(replace(session.info, start=start))
            for number, T_world_camera in enumerate(session.odometry.T_world_camera):
                time_s = float(session.odometry.timestamps_s[number])
                new.add_frame(T_world_camera, time_s, session.health[number])
            for submap in session.submaps:
                new.submaps.add(replace(submap, occupancy=_nothing()), compress=True)
        for kind in (AXES, RIG, LOOPS, KEYFRAME, RAYS):
            mapped.store.copy(kind, kept.store)
        kept.commit()


def _nothing() -> OccupancyPart:
    blocks, starts, cells = np.zeros(0, np.int64), np.zeros(1, np.int64), np.zeros(0, np.uint16)
    return OccupancyPart(clamped.CellRows(blocks, starts, cells, np.zeros((0, 3), np.float32)))
