"""The stateful part of mapping: odometry, and the submap under construction."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.geometry.se3 import transform_cloud
from recon.core.text import counted
from recon.core.values import PointCloud, RayCloud, RectifiedCamera
from recon.core.values.arrays import Float64, UInt8, freeze, tree_of
from recon.core.work import OneBehind, Stopwatch
from recon.look.geometry import MOST_EPIPOLAR_ERROR_PX
from recon.map.builders import (
    CloudBuilder,
    OccupancyBuilder,
    OccupancySettings,
    Submap,
    SubmapSettings,
    ray_grain,
    thin_rays,
)
from recon.map.fusion import FusionSettings, fusion_range_m, voxel_doublings
from recon.map.ground.axes import estimate_ground, map_axes
from recon.map.ground.level import NOT_KNOWN, TOO_FEW, Level
from recon.map.settings import DriveSettings
from recon.map.store.session import Session
from recon.odometry.checked import SegmentCounter
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryHealth, OdometryResult
from recon.stereo.frame import ReconstructedFrame


class Mapper:
    """Registers frames; integrates each into the current submap while the next is registered.

    What it makes is kept in the session, whose frames, submaps and rays are those before. ``up``,
    float64 (3,), is upwards in the axes of the first camera; None = as the ground below it shows.
    """

    def __init__(
        self,
        config: DriveSettings,
        camera: RectifiedCamera,
        odometry: Odometry,
        session: Session,
        stopwatch: Stopwatch,
        up: Float64 | None = None,
    ) -> None:
        self._config, self._camera, self._odometry = config, camera, odometry
        self._up = up
        self.session, self._stage = session, stopwatch.stage
        self._fusion_range_m = fusion_range_m(camera, config.fusion)
        self._behind = OneBehind()
        self._segments = SegmentCounter()
        self._builder: SubmapBuilder | None = None
        self._grain = ray_grain(config.occupancy) if config.occupancy.keep_rays else None
        # From world to map axes, and the height of the camera above the ground, if it was seen.
        self.axes: tuple[Float64, float | None] | None = None

    def __len__(self) -> int:
        return len(self.session)

    def register(self, frame: OdometryFrame) -> OdometryResult:
        with self._stage("odometry"):
            return self._odometry.register(frame)

    def add(
        self, frame: ReconstructedFrame, registered: OdometryResult, *, total: int
    ) -> FrameResult:
        """Add the next frame, whose pose is known, and start its integration."""
        T_world_camera = registered.T_world_camera
        health = replace(registered.health, warnings=(*frame.warnings, *registered.health.warnings))
        if (
            frame.epipolar_error_px is not None
            and not abs(frame.epipolar_error_px) <= MOST_EPIPOLAR_ERROR_PX
        ):
            note = f"left and right rows are {frame.epipolar_error_px:.0f} px apart"
            health = replace(health, ok=False, notes=(*health.notes, note))
        # A hole in the map is better than wrong geometry.
        cloud = frame.cloud if health.ok else frame.cloud.select(np.zeros(0, np.intp))
        rays = frame.rays if health.ok else None
        before, begun = self._segments.number, self._segments.begun
        segment = self._segments.add(health)
        if segment > before:
            self.close()  # the map may have to do without what follows
        builder = self._builder
        if builder is None or (health.ok and not begun):  # frames that show nothing come first
            builder = self.fix_axes(frame.cloud)
        work = (builder, len(self), cloud, rays, T_world_camera)
        self._behind.begin(partial(self._integrate, *work))
        self.session.add_frame(T_world_camera, frame.pair.timestamp_s, health)
        valid_ratio = float(np.mean(frame.disparity.measured))
        found = (len(frame.cloud), T_world_camera, health, segment, frame.pair.timestamp_s)
        return FrameResult(len(self) - 1, total, 0.0, valid_ratio, *found)

    def _integrate(
        self,
        builder: SubmapBuilder,
        frame: int,
        cloud: PointCloud,
        rays: RayCloud | None,
        T_world_camera: Float64,
    ) -> None:
        """Integrate a frame into the maps; runs while the next one is registered."""
        with self._stage("map"):
            rays = thin_rays(cloud, self._config.occupancy) if rays is None else rays
            near = cloud.select(cloud.xyz[:, 2] <= self._fusion_range_m)
            doublings = voxel_doublings(near.xyz[:, 2], self._camera, self._config.fusion)
            cloud_world = transform_cloud(near, T_world_camera, frame="world")
            builder.integrate(cloud_world, rays.cloud(), T_world_camera, doublings)
        with self._stage("store"):
            if self._grain is not None:
                self.session.add_rays(frame, rays, self._grain)
            if builder.full:
                self.session.submaps.add(builder.close())

    def wait(self) -> None:
        self._behind.wait()

    def abandon(self) -> None:
        """Stop after the integration in progress; required after an error, otherwise harmless."""
        self._behind.abandon()

    def close(self) -> None:
        """Close the current submap; a frame that comes later begins a new one."""
        self._behind.wait()
        if self._builder is not None and self._builder.frames:
            self.session.submaps.add(self._builder.close())

    def state(self) -> dict[str, Any]:
        """Return what later results depend on beside the session, as arrays and plain values."""
        self._behind.wait()
        return {
            "odometry": self._odometry.state(),
            "builder": None if self._builder is None else self._builder.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._odometry.restore(state["odometry"])
        for record in self.session.health:
            self._segments.add(record)
        if state["builder"] is not None:
            self._builder = self._new_builder()
            self._builder.restore(state["builder"])
            if self.session.submaps.frames + self._builder.frames != len(self):
                raise FormatError("submaps of the drive are missing")

    def fix_axes(self, cloud: PointCloud) -> SubmapBuilder:
        """Lay the axes of the map by the ground in a cloud, world axes; begin the first submap.

        A robot heads them, and levels them where no inertial unit does. What it says of its camera
        is forgotten where the only ground is one that it cannot stand on.
        """
        config, cloud, R_base_world = self._config, cloud.only_measured(), None
        up, given = self._up, config.axes.up
        if given is not None:
            up = np.array(given) / math.hypot(*given)
        ground, height_m = estimate_ground(cloud, config.scale, up), None
        if (mount := self.session.mount) is not None:
            R_base_world, height_m = mount.T_base_camera[:3, :3], mount.camera_height_m
            below = estimate_ground(cloud, config.scale, R_base_world[2])
            if ground is not None and below is None:
                self.session.mount = R_base_world = height_m = None
            ground = below or ground
        height_m = config.ground.camera_height_m or height_m
        T_map_world = map_axes(ground, config.axes, height_m, up, R_base_world)
        by = "robot" if R_base_world is not None else "first frame" if ground else NOT_KNOWN
        by = "setting" if config.axes.up is not None else by if up is None else "imu"
        self.session.level = Level(by, why="" if ground else TOO_FEW)
        self.session.set_axes(T_map_world, self._camera)
        seen_m = None if ground is None else ground.height_m
        self.axes = T_map_world, config.ground.camera_height_m or seen_m
        self._behind.wait()
        before, builder = self._builder, self._new_builder()
        if before is not None:
            builder.restore(before.state())
        self._builder = builder
        return builder

    def _new_builder(self) -> SubmapBuilder:
        config = self._config
        return SubmapBuilder(
            config.submaps,
            config.fusion,
            config.occupancy,
            self.session.T_map_world,
            config.memory.submap_bytes,
        )


_MAX_FRAMES: Final = 100
"""Frames after which a new submap begins at the latest, however slow the drive."""


class SubmapBuilder:
    """Builds the submaps of a drive, none of more than ``max_bytes`` (None = no limit)."""

    def __init__(
        self,
        settings: SubmapSettings,
        fusion: FusionSettings,
        occupancy: OccupancySettings,
        T_map_world: Float64,
        max_bytes: int | None = None,
    ) -> None:
        self._settings = settings
        self._max_bytes = max_bytes
        self._fused = CloudBuilder(fusion)
        self._occupancy = OccupancyBuilder(occupancy, T_map_world)
        self._index = 0
        self._first_frame = 0
        self.frames = 0
        self._path_m = 0.0
        self._last_m: Float64 | None = None

    def integrate(
        self,
        cloud_world: PointCloud,
        cloud_camera: PointCloud,
        T_world_camera: Float64,
        doublings: UInt8 | None = None,
    ) -> None:
        """Add a frame: ``cloud_world`` is fused, ``cloud_camera`` occupies and frees space."""
        self._fused.integrate(cloud_world, doublings)
        self._occupancy.integrate(cloud_camera, T_world_camera)
        place = T_world_camera[:3, 3]
        if self._last_m is not None:
            self._path_m += float(np.linalg.norm(place - self._last_m))
        self._last_m = place.copy()
        self.frames += 1

    @property
    def full(self) -> bool:
        s, limit = self._settings, self._max_bytes
        long = self._path_m >= s.length_m or self.frames >= _MAX_FRAMES
        return long or (limit is not None and self._fused.nbytes + self._occupancy.nbytes >= limit)

    def current(self) -> Submap:
        """Return the submap so far; without frames it is empty."""
        return Submap(
            self._index, self._first_frame, self.frames, self._fused.part(), self._occupancy.part()
        )

    def close(self) -> Submap:
        """Return the submap, whose place the next one takes."""
        submap = Submap(
            self._index,
            self._first_frame,
            self.frames,
            self._fused.take().rounded(),
            self._occupancy.take(),
        )
        self._first_frame += self.frames
        self._index, self.frames, self._path_m = self._index + 1, 0, 0.0
        return submap

    def state(self) -> dict[str, Any]:
        """Return all that decides what comes later, as a tree of arrays and plain values."""
        return {"submap": tree_of(self.current()), "path_m": self._path_m, "last_m": self._last_m}

    def restore(self, state: dict[str, Any]) -> None:
        submap = Submap.from_tree(state["submap"])
        self._index, self._first_frame = submap.index, submap.first_frame
        self.frames = submap.frames
        self._path_m, self._last_m = state["path_m"], state["last_m"]
        self._fused.resume(submap.fused, submap.frames)
        self._occupancy.resume(submap.occupancy)


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of one frame; a `Step` of the progress of a run."""

    index: int  # position in the run, from 0
    total: int  # number of frames in the run
    seconds: float  # time since the previous frame was done
    valid_ratio: float  # fraction of pixels with a disparity, in [0, 1]
    points: int  # number of points in the cloud of the frame
    T_world_camera: Float64  # (4, 4)
    health: OdometryHealth
    segment: int = 0  # of the drive, see `SegmentCounter`; -1 = the pose is not trusted
    time_s: float = math.nan

    def __post_init__(self) -> None:
        freeze(self, "T_world_camera", np.float64, (4, 4))

    @property
    def ok(self) -> bool:
        return self.health.ok

    @property
    def event(self) -> dict[str, Any]:
        """The frame for programs; what is NaN is None."""
        return {
            "event": "frame",
            "index": self.index,
            "total": self.total,
            "seconds": round(self.seconds, 4),
            **dict.fromkeys(("valid_ratio", "valid_share"), _finite(self.valid_ratio)),
            "points": self.points,
            "position_m": [_finite(x) for x in self.T_world_camera[:3, 3].tolist()],
            "measured": self.health.ok,
            "inliers": self.health.inliers,
            "notes": list(self.health.notes),
        }

    @property
    def state(self) -> str:
        """The frame for people: fraction of valid pixels, and whether the pose is trusted."""
        pose = counted(self.health.inliers, "inlier") if self.ok else "pose not trusted"
        return f"{100 * self.valid_ratio:.0f} % valid, {pose}"


def _finite(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
