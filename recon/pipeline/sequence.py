"""A drive, frame by frame: reconstruct, register, integrate."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from recon.errors import RegistrationError
from recon.odometry import KnownPoses, MotionPrior, Odometry, OdometryHealth, make_odometry
from recon.pipeline.config import ReconConfig
from recon.pipeline.drive_loops import DriveLoops, LoopWatch
from recon.pipeline.drive_map import DriveMap
from recon.pipeline.frame import FrameReconstructor, ReconstructedFrame
from recon.pipeline.lookahead import look_ahead
from recon.pipeline.machine import serial_algebra
from recon.pipeline.mapper import Mapper
from recon.pipeline.observer import FrameResult, Observer
from recon.pipeline.submap_store import SubmapStore
from recon.pipeline.workspace import Workspace
from recon.sources import StampedSource, StereoSource
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
        loops: What loop closure did to the trajectory; None = it was not asked.
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
    loops: DriveLoops | None = None

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

    def closed(self, loops: DriveLoops) -> MappedSequence:
        """The drive after its loops were closed: the path is bent, submaps move with it."""
        return replace(
            self,
            trajectory=loops.closure.trajectory,
            T_corrected_world=loops.submap_corrections(self.submaps.entries),
            loops=loops,
        )


def map_sequence(
    source: StereoSource,
    config: ReconConfig,
    *,
    known_poses: Trajectory | None = None,
    prior: Trajectory | None = None,
    observers: Iterable[Observer] = (),
    workspace: Workspace | None = None,
) -> MappedSequence:
    """Register and fuse all frames of a source, and close the loops of the path.

    The next frames are matched while this one is registered and the last one still goes into the
    map; the result does not depend on it.

    Args:
        source: Where the pairs come from.
        config: The configuration.
        known_poses: Poses to use instead of odometry, one per frame of the source; they are
            taken as they are, loops or not.
        prior: How the left camera moved by wheels, an inertial unit or a satellite receiver, on
            the clock of the source; only its motions count.
        observers: Told of the progress.
        workspace: What the run may keep on the disk, its threads, and who times it; None = in
            memory, all cores, nobody.

    Raises:
        ReconError: A frame cannot be read, matched or registered.
    """
    work = workspace or Workspace()
    audience = tuple(observers)
    reconstructor = FrameReconstructor(
        source.calibration, config, threads=work.threads, stopwatch=work.stopwatch
    )
    odometry = _odometry(config, source, known_poses, prior)
    looking = config.loops.enabled and known_poses is None
    loops = LoopWatch(config.loops, work.loops, work.stopwatch) if looking else None
    mapper = Mapper(config, reconstructor.camera, odometry, work)
    drive = _Drive(mapper, loops, config, work)
    for observer in audience:
        observer.on_start(source.name, len(source))
    try:
        with serial_algebra():
            pairs = source.frames(len(drive.mapper))
            for frame in look_ahead(reconstructor.reconstruct_to_map, pairs):
                result = drive.add(frame, total=len(source))
                for observer in audience:
                    observer.on_frame(result)
            drive.settle()
    finally:
        drive.stop()
        for observer in audience:
            observer.on_finish()
    return drive.finish(source, reconstructor)


class _Drive:
    """A mapper, who looks for loops beside it, its checkpoints, and its clock.

    Where there is a checkpoint to go on from, it does; the time up to there counts as spent.
    """

    def __init__(
        self, mapper: Mapper, loops: LoopWatch | None, config: ReconConfig, workspace: Workspace
    ) -> None:
        self.mapper = mapper
        self._loops = loops
        self._config = config
        self._checkpoint = workspace.checkpoint
        self._stage = workspace.stopwatch.stage
        self._sample: ReconstructedFrame | None = None
        self._saved = 0
        self._start = self._last = time.perf_counter()
        if workspace.resume and self._checkpoint is not None and self._checkpoint.exists():
            self._checkpoint.restore(self._restore)

    def add(self, frame: ReconstructedFrame, *, total: int) -> FrameResult:
        result = self.mapper.add(frame, total=total)
        if self._loops is not None:
            self._loops.add(frame, result.T_world_camera, measured=result.health.ok)
        if result.index <= total // 2:
            self._sample = frame
        if len(self.mapper) - self._saved >= self._config.checkpoints.every_frames:
            self._save()
        self._config.memory.check(f"frame {result.index}")
        now = time.perf_counter()
        seconds, self._last = now - self._last, now
        return replace(result, seconds=seconds)

    def settle(self) -> None:
        """Wait for what is done beside the registration: the last frame, and the loops."""
        self.mapper.settle()
        if self._loops is not None:
            self._loops.settle()
        self._last = time.perf_counter()

    def stop(self) -> None:
        """End what is done beside the registration, done or not."""
        self.mapper.abandon()
        if self._loops is not None:
            self._loops.stop()

    def finish(self, source: StereoSource, reconstructor: FrameReconstructor) -> MappedSequence:
        if not len(self.mapper):
            raise RegistrationError("the source has no frame")
        if len(self.mapper) > self._saved:
            self._save()
        self.mapper.close()
        mapped = MappedSequence(
            trajectory=self.mapper.trajectory,
            health=self.mapper.health,
            submaps=self.mapper.submaps,
            config=self._config,
            T_map_world=self.mapper.T_map_world,
            camera=reconstructor.camera,
            sample=self._sample or self._sample_again(source, reconstructor),
            seconds=self._last - self._start,
        )
        if self._loops is None:
            return mapped
        with self._stage("close_loops"):
            return mapped.closed(self._loops.close(mapped.trajectory))

    def _restore(self, state: dict[str, Any]) -> None:
        self.mapper.restore(state["mapper"])
        if self._loops is not None:
            path, health = self.mapper.trajectory, self.mapper.health
            self._loops.restore(path.T_world_camera, [record.ok for record in health])
        self._saved = len(self.mapper)
        self._last = time.perf_counter()
        self._start = self._last - state["seconds"]

    def _save(self) -> None:
        if self._checkpoint is None:
            return
        self.settle()  # or keyframes that a resumed run counts on might be missing
        with self._stage("checkpoint"):
            seconds = time.perf_counter() - self._start
            self._checkpoint.save({"mapper": self.mapper.state(), "seconds": seconds})
        self._saved = len(self.mapper)

    def _sample_again(
        self, source: StereoSource, reconstructor: FrameReconstructor
    ) -> ReconstructedFrame:
        """The frame to look at, which was mapped before this process began."""
        index = min(len(source) // 2, len(self.mapper) - 1)
        return reconstructor.reconstruct(next(source.frames(index)))


def _odometry(
    config: ReconConfig,
    source: StereoSource,
    known_poses: Trajectory | None,
    prior: Trajectory | None,
) -> Odometry:
    if known_poses is None:
        if prior is not None and isinstance(source, StampedSource):
            MotionPrior(prior, config.odometry.prior).check_covers(source.stamps_s)
        return make_odometry(config.odometry.method, config.odometry, prior)
    if len(known_poses) < len(source):
        raise RegistrationError(
            "fewer known poses than frames",
            got=f"{len(known_poses)} poses",
            expected=f"{len(source)}",
            hint="the pose file must list every frame of the source",
        )
    return KnownPoses(known_poses)
