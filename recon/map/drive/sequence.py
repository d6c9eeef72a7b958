"""A drive, frame by frame: reconstruct, register, integrate."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from recon.core.geometry.axes import transform_cloud
from recon.core.geometry.se3 import apply, invert
from recon.core.values import (
    OccupancyVoxels,
    PointCloud,
    RectifiedCamera,
    Trajectory,
    join_clouds,
    join_voxels,
)
from recon.core.values.arrays import Bool, Float64
from recon.map.drive.drive import Drive
from recon.map.drive.drive_loops import DriveLoops, LoopWatch
from recon.map.drive.drive_odometry import UsedPrior, axes_of, odometry_of
from recon.map.drive.mapper import Mapper
from recon.map.drive.workspace import Workspace
from recon.map.occupancy.looks import Looks
from recon.map.settings import DriveSettings
from recon.map.store.cast_submaps import looks_of
from recon.map.store.session import Session
from recon.map.store.submaps import Submaps
from recon.map.tiles import Tiles
from recon.odometry.health import trusted_poses
from recon.odometry.path_drift import ExpectedDrift, expected_drift
from recon.odometry.protocol import OdometryHealth
from recon.run.progress import SILENT, Progress
from recon.run.threads import serial_algebra
from recon.sources.protocol import StereoSource
from recon.stereo.frame import FrameReconstructor, ReconstructedFrame


@dataclass(frozen=True, eq=False)
class MappedSequence:
    """A mapped drive, before its results are written.

    Attributes:
        trajectory: Pose of the left camera in each frame.
        health: Health of each pose.
        session: What the map keeps of the drive.
        submaps: Fused cloud and occupancy, in submaps of consecutive frames.
        config: The configuration.
        T_map_world: float64 (4, 4).
        camera: The rectified camera.
        sample: The frame in the middle of the drive, for display.
        seconds: Wall-clock time from the first frame to the last.
        T_corrected_world: float64 (S, 4, 4), correction still to be applied to each submap; the
            trajectory already includes it. None = none.
        loops: Result of loop closure; None = it was not run.
        prior: How the external trajectory was used; None = there was none.
    """

    trajectory: Trajectory
    health: tuple[OdometryHealth, ...]
    session: Session
    submaps: Submaps
    config: DriveSettings
    T_map_world: Float64
    camera: RectifiedCamera
    sample: ReconstructedFrame
    seconds: float
    T_corrected_world: Float64 | None = None
    loops: DriveLoops | None = None
    prior: UsedPrior | None = None

    def __repr__(self) -> str:
        trusted = int(self.trusted.sum())
        return f"MappedSequence({self.trajectory}, {trusted} of them trusted, {self.seconds:.4g} s)"

    @property
    def path_m(self) -> Float64:
        """float64 (N, 3), positions of the camera, map axes."""
        return apply(self.T_map_world, self.trajectory.positions_m)

    @property
    def trusted(self) -> Bool:
        """bool (N,), which poses are to be trusted."""
        return trusted_poses(self.health)

    @cached_property
    def tiles(self) -> Tiles:
        """Fused cloud and occupancy, tile by tile."""
        tiles = Tiles.of_submaps(
            self.submaps, self.config, self.T_map_world, self.T_corrected_world
        )
        return tiles.with_looks(self.looks)

    @cached_property
    def looks(self) -> Looks | None:
        """What each frame saw, from its rays; None where they were not kept."""
        T_map_camera = self.T_map_world @ self.trajectory.T_world_camera
        return looks_of([(self.session, T_map_camera, ())], self.config.occupancy)

    @cached_property
    def cloud(self) -> PointCloud:
        """The whole fused cloud, frame ``world``; for long drives, see `tiles`."""
        whole = join_clouds(tile.cloud for tile in self.tiles)
        return transform_cloud(whole, invert(self.T_map_world), frame="world")

    @cached_property
    def voxels(self) -> OccupancyVoxels:
        """The whole 3-D occupancy, map axes; for long drives, see `tiles`."""
        return join_voxels((tile.voxels for tile in self.tiles), self.tiles.resolution_m)

    @cached_property
    def expected_drift(self) -> ExpectedDrift | None:
        """How far the path may be off; None where no motion was measured."""
        return expected_drift(self.trajectory, self.health, self.camera)

    def corrected(self, T_corrected_world: Float64) -> MappedSequence:
        """Return the drive with each submap and its part of the path moved rigidly.

        Args:
            T_corrected_world: float64 (S, 4, 4), one correction per submap.
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
        """Return the drive after loop closure: the corrected path, and submaps that follow it."""
        return replace(
            self,
            trajectory=loops.closure.trajectory,
            T_corrected_world=loops.submap_corrections(self.submaps.entries),
            loops=loops,
        )


def map_sequence(
    source: StereoSource,
    config: DriveSettings,
    *,
    known_poses: Trajectory | None = None,
    prior: Trajectory | None = None,
    progress: Progress = SILENT,
    workspace: Workspace | None = None,
) -> MappedSequence:
    """Register and fuse all frames of a source, and close loops in the path.

    Matching of the next frames, registration of this one and integration of the last one overlap,
    which does not change the result. Of a live source the poses come first (`poses_first`).

    Args:
        source: The source of stereo pairs.
        config: The configuration.
        known_poses: Poses to use instead of odometry, one per frame of the source; used
            unchanged, without loop closure.
        prior: Motion of the left camera from wheel odometry, an IMU or GNSS, in the time base of
            the source; only relative motions are used.
        progress: Shown each frame.
        workspace: Map, threads and stopwatch of the run; None = a temporary map, all cores,
            not timed.

    Raises:
        ReconError: A frame cannot be read, matched or registered.
    """
    work = workspace or Workspace()
    reconstructor = FrameReconstructor(
        source.calibration, config, threads=work.threads, stopwatch=work.stopwatch
    )
    used = None
    if prior is not None and known_poses is None:
        used = axes_of(prior, source, reconstructor, config.odometry.prior)
    odometry = odometry_of(config, source, known_poses, prior, used)
    looking = config.loops.enabled and known_poses is None
    session = work.session(source, config)
    watch = LoopWatch(session.keyframes, work.stopwatch, search=looking)
    mapper = Mapper(config, reconstructor.camera, odometry, session, work.stopwatch)
    drive = Drive(mapper, watch, config, work)
    steps = drive.frames(source, reconstructor)
    progress.on_start(source.name, len(source))
    try:
        with serial_algebra(), closing(steps):
            for step in steps:
                progress.on_step(step)
            drive.wait()
    finally:
        drive.stop()
        progress.on_finish()
    return replace(_mapped(drive, source, reconstructor), prior=used)


def _mapped(
    drive: Drive, source: StereoSource, reconstructor: FrameReconstructor
) -> MappedSequence:
    """Complete a drive."""
    drive.finish()
    session = drive.session
    mapped = MappedSequence(
        trajectory=session.odometry,
        health=session.health,
        session=session,
        submaps=session.submaps,
        config=drive.config,
        T_map_world=session.T_map_world,
        camera=reconstructor.camera,
        sample=drive.sample or _sample_again(len(session), source, reconstructor),
        seconds=drive.seconds,
    )
    loops = drive.close_loops(mapped.trajectory)
    return mapped if loops is None else mapped.closed(loops)


def _sample_again(
    mapped: int, source: StereoSource, reconstructor: FrameReconstructor
) -> ReconstructedFrame:
    """Reconstruct the frame in the middle, which was mapped before this process started."""
    index = min(len(source) // 2, mapped - 1)
    return reconstructor.reconstruct(next(source.frames(index)))
