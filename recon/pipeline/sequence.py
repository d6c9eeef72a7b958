"""A drive, frame by frame: reconstruct, register, integrate."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from recon.errors import RegistrationError
from recon.geometry.transform import transform_cloud
from recon.mapping import SubmapBuilder, estimate_ground, fusion_range_m, map_axes
from recon.odometry import KnownPoses, Odometry, OdometryFrame, OdometryHealth, make_odometry
from recon.pipeline.config import ReconConfig
from recon.pipeline.drive_map import DriveMap
from recon.pipeline.frame import FrameReconstructor, ReconstructedFrame
from recon.pipeline.lookahead import look_ahead
from recon.pipeline.machine import serial_algebra
from recon.pipeline.observer import FrameResult, Observer
from recon.pipeline.stopwatch import Stopwatch
from recon.pipeline.submap_store import SubmapStore
from recon.pipeline.workspace import Workspace
from recon.sources import StereoSource
from recon.structures import OccupancyVoxels, PointCloud, RectifiedCamera, Trajectory
from recon.structures.arrays import Float64


@dataclass(frozen=True, eq=False)
class MappedSequence:
    """What a drive gives before anything is written.

    Attributes:
        trajectory: Pose of the left camera in each frame.
        health: How far each pose can be trusted.
        submaps: Fused cloud and occupancy in pieces of consecutive frames.
        config: The configuration.
        T_map_world: float64 (4, 4).
        camera: The rectified camera.
        sample: The frame in the middle of the drive, to look at.
        seconds: Wall-clock time from the first frame to the last.
        T_corrected_world: float64 (S, 4, 4), a motion that each submap still has to make; the
            trajectory has made it. None = none.
    """

    trajectory: Trajectory
    health: tuple[OdometryHealth, ...]
    submaps: SubmapStore
    config: ReconConfig
    T_map_world: Float64
    camera: RectifiedCamera
    sample: ReconstructedFrame
    seconds: float
    T_corrected_world: Float64 | None = None

    @cached_property
    def map(self) -> DriveMap:
        """Fused cloud and occupancy, tile by tile."""
        return DriveMap(self.submaps, self.config, self.T_map_world, self.T_corrected_world)

    @cached_property
    def cloud(self) -> PointCloud:
        """The whole fused cloud, frame ``world``; for long drives, see `map`."""
        return self.map.cloud()

    @cached_property
    def voxels(self) -> OccupancyVoxels:
        """The whole 3-D occupancy, map axes; for long drives, see `map`."""
        return self.map.voxels()

    def corrected(self, T_corrected_world: Float64) -> MappedSequence:
        """The drive with each submap, and the path in it, moved rigidly.

        Args:
            T_corrected_world: float64 (S, 4, 4), one motion for each submap.
        """
        entries = self.submaps.entries
        of_frame = np.repeat(np.arange(len(entries)), [entry.frames for entry in entries])
        poses = T_corrected_world[of_frame] @ self.trajectory.T_world_camera
        return replace(
            self,
            trajectory=replace(self.trajectory, T_world_camera=poses),
            T_corrected_world=T_corrected_world,
        )


def map_sequence(
    source: StereoSource,
    config: ReconConfig,
    *,
    known_poses: Trajectory | None = None,
    observers: Iterable[Observer] = (),
    threads: int | None = None,
    workspace: Workspace | None = None,
) -> MappedSequence:
    """Register and fuse all frames of a source.

    The next frames are matched while this one is registered; the result does not depend on it.

    Args:
        source: Where the pairs come from.
        config: The configuration.
        known_poses: Poses to use instead of odometry, one per frame of the source.
        observers: Told of the progress.
        threads: Threads to use; None = all cores. Changes no result.
        workspace: What the run may keep on the disk, and who times it; None = in memory, nobody.

    Raises:
        ReconError: A frame cannot be read, matched or registered.
    """
    work = workspace or Workspace()
    watch = work.stopwatch
    audience = tuple(observers)
    reconstructor = FrameReconstructor(source.calibration, config, threads=threads, stopwatch=watch)
    odometry = _odometry(config, known_poses, frames=len(source))
    store = SubmapStore(work.folder)
    mapper = _Mapper(
        config, reconstructor.camera, odometry, watch, store, sample_at=len(source) // 2
    )
    for observer in audience:
        observer.on_start(source.name, len(source))
    start = last = time.perf_counter()
    try:
        with serial_algebra():
            for frame in look_ahead(reconstructor.reconstruct, source):
                result = mapper.add(frame, total=len(source))
                now = time.perf_counter()
                _tell(audience, replace(result, seconds=now - last))
                last = now
    finally:
        for observer in audience:
            observer.on_finish()
    return mapper.finish(seconds=last - start)


def _tell(audience: Iterable[Observer], result: FrameResult) -> None:
    for observer in audience:
        observer.on_frame(result)


class _Mapper:
    """The part of the flow that holds state: odometry and the two maps."""

    def __init__(
        self,
        config: ReconConfig,
        camera: RectifiedCamera,
        odometry: Odometry,
        stopwatch: Stopwatch,
        store: SubmapStore,
        *,
        sample_at: int,
    ) -> None:
        self._config = config
        self._odometry = odometry
        self._stopwatch = stopwatch
        self._sample_at = sample_at
        self._camera = camera
        self._fusion_range_m = fusion_range_m(camera, config.fusion)
        self._store = store
        self._builder: SubmapBuilder | None = None
        self._T_map_world = np.eye(4)
        self._poses: list[Float64] = []
        self._times_s: list[float] = []
        self._health: list[OdometryHealth] = []
        self._sample: ReconstructedFrame | None = None

    def add(self, frame: ReconstructedFrame, *, total: int) -> FrameResult:
        index, stage = len(self._poses), self._stopwatch.stage
        with stage("odometry"):
            registered = self._odometry.register(OdometryFrame(frame.pair, frame.disparity))
        T_world_camera = registered.T_world_camera
        health = replace(registered.health, warnings=(*frame.warnings, *registered.health.warnings))
        with stage("map"):
            near = frame.cloud.select(frame.cloud.xyz[:, 2] <= self._fusion_range_m)
            cloud_world = transform_cloud(near, T_world_camera, frame="world")
            builder = self._builder_from(frame)
            builder.integrate(cloud_world, frame.cloud, T_world_camera)
        with stage("store"):
            if builder.full:
                self._store.add(builder.close())
        self._poses.append(T_world_camera)
        self._times_s.append(frame.pair.timestamp_s)
        self._health.append(health)
        if index <= self._sample_at:
            self._sample = frame
        valid_share = float(np.mean(frame.disparity.valid))
        return FrameResult(index, total, 0.0, valid_share, len(frame.cloud), T_world_camera, health)

    def finish(self, *, seconds: float) -> MappedSequence:
        if self._sample is None or self._builder is None:
            raise RegistrationError("the source has no frame")
        if self._builder.frames:
            self._store.add(self._builder.close())
        return MappedSequence(
            trajectory=Trajectory(np.stack(self._poses), np.array(self._times_s)),
            health=tuple(self._health),
            submaps=self._store,
            config=self._config,
            T_map_world=self._T_map_world,
            camera=self._camera,
            sample=self._sample,
            seconds=seconds,
        )

    def _builder_from(self, frame: ReconstructedFrame) -> SubmapBuilder:
        """The maps that are being built; the first frame fixes their axes."""
        if self._builder is None:
            config = self._config
            ground = estimate_ground(frame.cloud, config.axes)
            self._T_map_world = map_axes(ground, config.axes)
            self._builder = SubmapBuilder(
                config.submaps, config.fusion, config.occupancy, self._T_map_world
            )
        return self._builder


def _odometry(config: ReconConfig, known_poses: Trajectory | None, *, frames: int) -> Odometry:
    if known_poses is None:
        return make_odometry(config.odometry.method, config.odometry)
    if len(known_poses) < frames:
        raise RegistrationError(
            "fewer known poses than frames",
            got=f"{len(known_poses)} poses",
            expected=f"{frames}",
            hint="the pose file must list every frame of the source",
        )
    return KnownPoses(known_poses)
