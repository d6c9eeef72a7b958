"""A drive, frame by frame: reconstruct, register, integrate."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply, invert, transform_cloud
from recon.core.machine import available_cores
from recon.core.progress import series, stage
from recon.core.text import counted, metres
from recon.core.values import (
    Disparity,
    OccupancyVoxels,
    PointCloud,
    RectifiedCamera,
    Trajectory,
    join_clouds,
    join_voxels,
)
from recon.core.values.arrays import Bool, Float64
from recon.core.values.camera import depth_from_disparity
from recon.core.work import serial_algebra
from recon.look.tracks import LiveTracks, StereoTracks
from recon.map.drive.drive import Drive, Workspace
from recon.map.drive.drive_loops import DriveLoops, LoopWatch
from recon.map.drive.drive_odometry import (
    UsedPrior,
    arriving_guide,
    axes_of,
    imu_of,
    mount_of,
    odometry_of,
)
from recon.map.drive.mapper import Mapper
from recon.map.fusion import fusion_range_m
from recon.map.map import Map
from recon.map.sessions.placed import PlacedMap, place_map
from recon.map.settings import DriveSettings
from recon.map.store.session import Session
from recon.map.tiles import Tiles
from recon.odometry.checked import CheckedOdometry
from recon.odometry.guide import Guide
from recon.odometry.health import name_frames, segment_numbers
from recon.odometry.imu_fit import FittedImu
from recon.odometry.protocol import Odometry, OdometryHealth
from recon.odometry.sfm import FoundOdometry, FoundPoses, SfmOptions, find_poses
from recon.odometry.visual import VisualOdometry
from recon.sources.source import StereoSource, check_source
from recon.stereo.frame import CloudSettings, FrameReconstructor, ReconstructedFrame


@dataclass(frozen=True)
class DriveSegment:
    """A part of a drive in which odometry was never lost."""

    first: int  # its first frame
    last: int  # its last frame
    frames: int  # how many of them have a trusted pose
    joined: bool  # whether it is in the map: places that were seen again say where it lies


@dataclass(frozen=True, eq=False)
class MappedSequence:
    """A drive whose map is made: the map itself, and what it cost and looked like.

    What was asked for once is known after the map is closed, too.

    Attributes:
        map: The map, in which the drive is the only session.
        sample: The frame in the middle of the drive, for display.
        seconds: Wall-clock time from the first frame to the last.
        loops, prior, imu, sfm: What came of loop closure, of an external trajectory, of an inertial
            unit, of structure from motion; None = they were not used.
        threads: Threads with which rays are cast.
        tracks: What a drive showed of its rig while it arrived; empty of any other.
        doubts: Why what the robot says of where its camera is was not used.
    """

    map: Map
    config: DriveSettings
    sample: ReconstructedFrame
    seconds: float
    loops: DriveLoops | None = None
    prior: UsedPrior | None = None
    imu: FittedImu | None = None
    sfm: FoundPoses | None = None
    threads: int = 1
    tracks: Sequence[StereoTracks] = ()
    doubts: Sequence[str] = ()

    def __repr__(self) -> str:
        trusted = int(self.trusted.sum())
        return f"MappedSequence({self.trajectory}, {trusted} of them trusted, {self.seconds:.4g} s)"

    @cached_property
    def session(self) -> Session:
        """What the map keeps of the drive."""
        return self.map.first

    @cached_property
    def camera(self) -> RectifiedCamera:
        return self.session.camera

    @cached_property
    def T_map_world(self) -> Float64:
        """float64 (4, 4), from world to map axes."""
        return self.session.T_map_world

    @cached_property
    def trajectory(self) -> Trajectory:
        """Pose of the left camera in each frame, after loop closure."""
        return self.session.trajectory

    @property
    def health(self) -> tuple[OdometryHealth, ...]:
        return self.session.health

    @property
    def trusted(self) -> Bool:
        """bool (N,), which poses are to be trusted."""
        return self.session.trusted

    @cached_property
    def joined(self) -> Bool:
        """bool (N,), which frames are part of the path in the map, see `Map.joined`."""
        return self.map.joined(self.session)

    @cached_property
    def segments(self) -> list[DriveSegment]:
        """The parts of the drive between its breaks, in order."""
        segment = segment_numbers(self.health)
        parts = [np.flatnonzero(segment == n) for n in range(int(segment.max(initial=-1)) + 1)]
        return [
            DriveSegment(int(own[0]), int(own[-1]), len(own), bool(self.joined[own[0]]))
            for own in parts
        ]

    @property
    def path_m(self) -> Float64:
        """float64 (N, 3), positions of the camera, map axes."""
        return apply(self.T_map_world, self.trajectory.positions_m)

    @cached_property
    def placed(self) -> PlacedMap:
        """The map in tiles, from which its products are made."""
        return place_map(self.map, self.config, self.threads)

    @property
    def tiles(self) -> Tiles:
        """Fused cloud and occupancy, tile by tile."""
        return self.placed.tiles

    @cached_property
    def cloud(self) -> PointCloud:
        """The whole fused cloud, frame ``world``; for long drives, see `tiles`."""
        whole = join_clouds(tile.cloud for tile in self.tiles)
        return transform_cloud(whole, invert(self.T_map_world), frame="world")

    @cached_property
    def voxels(self) -> OccupancyVoxels:
        """The whole 3-D occupancy, map axes; for long drives, see `tiles`."""
        return join_voxels((tile.voxels for tile in self.tiles), self.tiles.resolution_m)


def break_warnings(mapped: MappedSequence) -> list[str]:
    """Return what to know first of all about a drive whose odometry was lost."""
    segments = mapped.segments
    if len(segments) < 2:
        return []
    apart = [segment for segment in segments if not segment.joined]
    if not apart:
        return [
            f"the trajectory has {counted(len(segments), 'segment')}, which loop closures connect"
        ]
    lost, frames = sum(one.frames for one in apart), sum(one.frames for one in segments)
    named = name_frames([n for one in apart for n in range(one.first, one.last + 1)])
    way_on = "" if mapped.sfm else "; recon map --odometry sfm takes frames in any order"
    missing = f"{lost} of {counted(frames, 'frame')} are not in the map{way_on}"
    into = counted(len(segments), "segment")
    return [f"TRAJECTORY HAS {into.upper()}: no loop closure connects {named}; {missing}"]


def map_sequence(
    source: StereoSource,
    config: DriveSettings,
    *,
    known_poses: Trajectory | None = None,
    prior: Trajectory | None = None,
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
        workspace: Map, threads and stopwatch of the run; None = a temporary map, all cores,
            not timed.

    Raises:
        ReconError: A frame cannot be read, matched or registered.
    """
    check_source(source)
    work = workspace or Workspace()
    reconstructor = FrameReconstructor(
        source.calibration,
        config,
        threads=work.threads,
        stopwatch=work.stopwatch,
        check_epipolar=not source.rigid,
    )
    by_sfm = config.odometry.method == "sfm" and known_poses is None
    used = imu = None
    if prior is not None and known_poses is None:
        used = axes_of(prior, source, reconstructor, config.odometry.prior)
    elif known_poses is None and not by_sfm:
        imu = imu_of(source, reconstructor, config)
    guide: Guide | None = None if imu is None else imu.guide
    if source.live and known_poses is None and not by_sfm:
        guide = arriving_guide(source, reconstructor, config)
    session = work.session(source, config)
    odometry: Odometry
    if by_sfm:
        stage("register the photos")
        odometry = _photos(source, config, work, session)
    else:
        odometry = odometry_of(config, source, known_poses, prior, used, guide)
    looking = config.loops.enabled and known_poses is None and not by_sfm
    watch = LoopWatch(
        session.keyframes,
        reconstructor.camera,
        work.stopwatch,
        search=looking,
        scale=config.scale,
    )
    mount, doubts = mount_of(source, config.rectification)
    if not len(session):
        session.mount = mount
    up = None if imu is None or imu.guide is None else imu.guide.up
    mapper = Mapper(config, reconstructor.camera, odometry, session, work.stopwatch, up)
    checked = odometry.odometry if isinstance(odometry, CheckedOdometry) else None
    tracks = None
    if source.live and source.stereo and isinstance(checked, VisualOdometry):
        tracks = LiveTracks(checked)
    drive = Drive(source, reconstructor, mapper, watch, config, work)
    if isinstance(odometry, FoundOdometry) and not len(mapper):
        drive.begin_at(int(odometry.found.models[0].frames[0]))
    steps = drive.frames(tracks)
    stage("map")
    try:
        with serial_algebra(), series(source.name, len(source)) as shown, closing(steps):
            for step in steps:
                drive.tell(step)
                shown.on_step(step)
            drive.wait()
        drive.finish()
    finally:
        drive.stop()
    stage("close loops")
    if mount is not None and session.mount is None:
        hint = f"it is not used; is {mount.camera} an optical frame (z forward)?"
        doubts = [f"{mount.base} does not stand on the ground that is seen: {hint}"]
    return MappedSequence(
        map=work.map,
        config=config,
        sample=drive.sample or drive.sample_again(),
        seconds=drive.seconds,
        loops=drive.settle(session.odometry, None if imu is None else imu.guide),
        prior=used,
        imu=imu,
        doubts=doubts,
        sfm=odometry.found if isinstance(odometry, FoundOdometry) else None,
        threads=work.threads or 1,
        tracks=() if tracks is None else tracks.windows,
    )


def _photos(
    source: StereoSource, config: DriveSettings, work: Workspace, session: Session
) -> FoundOdometry:
    """Return the poses of pairs in any order, which an interrupted drive has found already."""
    path = work.map.store.path
    options = SfmOptions(
        config.rectification,
        None if path is None else path.parent,
        work.threads or available_cores(),
        config.memory.limit_mb,
        work.stopwatch,
    )
    if session.state() is not None:
        return FoundOdometry()
    found = find_poses(source, options)
    config.memory.check("structure from motion")
    return FoundOdometry(found)


_AUDIT: Final = "recon audit SOURCE shows what is wrong"
_PRIOR: Final = (
    "check the prior: its axes (--set odometry.prior.axes=auto finds them), its unit (metres) and "
    "its clock"
)


def check_cloud(frame: ReconstructedFrame, settings: CloudSettings, where: str) -> None:
    """Refuse a pair whose matches give no point."""
    if not len(frame.cloud):
        farthest = "any depth" if settings.max_range_m is None else f"{settings.max_range_m:g} m"
        limits = f"from {settings.min_range_m:g} m to {farthest}"
        if settings.max_relative_sigma is not None:
            limits += f", known to {100 * settings.max_relative_sigma:g} % of it"
        raise MappingError(
            "the cloud is empty",
            where=where,
            got=_depths(frame.disparity, frame.pair.camera),
            expected=f"points {limits}",
            hint="check the unit of the baseline, or set cloud.max_range_m and "
            "cloud.max_relative_sigma",
        )


def check_map(mapped: MappedSequence, where: str, findings: Sequence[str] = ()) -> None:
    """Refuse a drive that gives no map; ``findings`` of an audit come with the worst first."""
    if any(len(tile.cloud) for tile in mapped.tiles):
        return
    why, hint = _explain_poses(mapped.health) or _explain_sample(mapped)
    hint = "; ".join((*findings[:1], hint))
    raise MappingError(f"the map is empty: {why}", where=where, hint=hint)


def _explain_poses(health: Sequence[OdometryHealth]) -> tuple[str, str] | None:
    """Return what is wrong with the poses, and what to do; None if most are trusted."""
    bad = [record for record in health if not record.ok]
    if 2 * len(bad) <= len(health):
        return None
    notes = [note for record in bad for note in record.notes]
    # Notes differ in their numbers.
    kinds = Counter(re.sub(r"\d+", "", note) for note in notes)
    most = next((n for n in notes if re.sub(r"\d+", "", n) == kinds.most_common(1)[0][0]), "")
    found = f"{len(bad)} of {counted(len(health), 'pose')} are not to be trusted ({most})"
    return found, _PRIOR if "prior" in most else f"{_AUDIT} with the images"


def _explain_sample(mapped: MappedSequence) -> tuple[str, str]:
    """Return why nothing of the frame in the middle of the drive is in the map, and what to do."""
    config, frame = mapped.config, mapped.sample
    if not len(frame.cloud):
        found = _depths(frame.disparity, mapped.camera)
        hint = "see cloud.max_range_m and cloud.max_relative_sigma"
        return f"no point in the middle of the drive: {found}", f"{_AUDIT}; {hint}"
    nearest_m = float(frame.cloud.xyz[:, 2].min())
    reach_m = fusion_range_m(mapped.camera, config.fusion)
    if nearest_m > reach_m:
        got = f"the nearest point is {metres(nearest_m)} away, the map ends at {metres(reach_m)}"
        return got, "allow larger errors with --set fusion.max_depth_error_m="
    got = f"of {counted(len(mapped.trajectory), 'frame')}, too few saw the same place"
    return got, "use recon pair for a single pair, or lower fusion.min_count"


def _depths(disparity: Disparity, camera: RectifiedCamera) -> str:
    ratio = f"{100 * float(disparity.measured.mean()):.1f} % of the pixels matched"
    if not disparity.measured.any():
        return ratio
    depth_m = depth_from_disparity(disparity.values[disparity.measured], camera)
    low, high = np.nanpercentile(depth_m, [5, 95])
    return f"{ratio}, at {low:.3g} to {high:.3g} m"
