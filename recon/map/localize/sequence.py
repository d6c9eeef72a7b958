"""A whole drive located in a map, and its figures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from recon.core.errors import MappingError, RegistrationError
from recon.core.progress import LOGGER, series, stage
from recon.core.settings import scaled
from recon.core.summary import Figures, Rows, RunSummary, inline, optional
from recon.core.text import counted, metres
from recon.core.values import OccupancyGrid, Recorded, Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.core.work import look_ahead, serial_algebra
from recon.look.rig import RigFigures
from recon.map.drive.drive import Workspace
from recon.map.drive.drive_odometry import mount_of
from recon.map.listener import DriveBegun, PoseTeller
from recon.map.localize.localizer import Localizer, Located, State
from recon.map.localize.surroundings import Surroundings
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile, known_places
from recon.odometry.kiss import RANGE_M
from recon.odometry.protocol import OdometryFrame
from recon.sources.source import Mount, SourceFigures, StereoSource, check_source
from recon.stereo.frame import FrameReconstructor

START_WITHIN_M: Final = 10.0  # how far from the start that is given the first fix may be
START_WITHIN_DEG: Final = 60.0  # how far its heading may be from the one that is given


@dataclass(frozen=True)
class StartPose:
    """Roughly where a drive begins, in map axes; the heading is from the x axis to the y axis."""

    x_m: float
    y_m: float
    yaw_deg: float

    @classmethod
    def of(cls, T_map_camera: Float64) -> StartPose:
        """Return where a camera is that looks along its z axis; (4, 4)."""
        ahead_x, ahead_y = T_map_camera[:2, 2].tolist()
        x_m, y_m = T_map_camera[:2, 3].tolist()
        return cls(x_m, y_m, math.degrees(math.atan2(ahead_y, ahead_x)))

    def among(self, T_map_camera: Float64) -> Bool:
        """Return which views (N, 4, 4) are near; `MappingError` if none is."""
        near = self.near(T_map_camera)
        if not near.any():
            raise MappingError(
                "no keyframe of the map is near the start pose",
                got=f"{self.x_m:g},{self.y_m:g},{self.yaw_deg:g}",
                expected=f"one within {START_WITHIN_M:g} m and {START_WITHIN_DEG:g}°",
                hint="x and y in metres and the heading in degrees, in map axes",
            )
        return near

    def near(self, T_map_camera: Float64) -> Bool:
        off = T_map_camera[:, :2, 3] - (self.x_m, self.y_m)
        c, s = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        ahead = T_map_camera[:, :2, 2] @ np.array([[c, -s], [s, c]])
        turned = np.abs(np.arctan2(ahead[:, 1], ahead[:, 0]))
        near_m = np.hypot(off[:, 0], off[:, 1])
        return np.asarray((near_m <= START_WITHIN_M) & (turned <= math.radians(START_WITHIN_DEG)))


@dataclass(frozen=True, eq=False)
class LocalizedFrame:
    """Where one frame is; a `Step` of progress. ``seconds`` is without matching."""

    index: int
    time_s: float
    seconds: float
    located: Located

    @property
    def ok(self) -> bool:
        """Whether its pose is trusted, if it has one; where the drive is lost, it was not."""
        return self.located.state is not State.LOST

    @property
    def event(self) -> dict[str, Any]:
        T = self.located.T_world_camera
        return {
            "event": "frame",
            "index": self.index,
            "seconds": round(self.seconds, 4),
            "state": self.located.state.value,
            "position_m": None if T is None else T[:3, 3].round(6).tolist(),
            "views": self.located.views,
            "inliers": self.located.inliers,
            "surfaces": self.located.surfaces,
            "sigma_m": None if T is None else round(self.located.sigma_m, 6),
            "note": self.located.note,
        }

    @property
    def state(self) -> str:
        found = self.located
        if found.state is not State.TRACKING:
            return f"{found.state.value}: {found.note}"
        by = f"{counted(found.inliers, 'inlier')} in {counted(found.views, 'view')}"
        return f"{found.state.value}, {by}"


@dataclass(frozen=True)
class FrameSeconds(Figures):
    """Times that frames took, in seconds."""

    median: float
    p95: float
    max: float


@dataclass(frozen=True, kw_only=True)
class LocalizedFigures(Figures):
    """In how many frames the drive was found in the map, and how precisely."""

    frames: int
    frames_searching: int
    frames_tracking: int
    frames_coasting: int
    frames_lost: int
    first_fix_frame: int | None  # the first frame with a pose; None = there is none
    median_sigma_m: float | None  # standard deviation of a position
    fps: float | None
    seconds_per_frame: FrameSeconds


@dataclass(frozen=True, eq=False)
class LocalizedDrive:
    """A drive in a map: all its frames in order, and the seconds from the first to the last.

    ``T_map_world``, float64 (4, 4), is from the world of the map to its axes; ``mount`` where the
    rectified left camera is on the robot, else on that of the map; ``doubts`` why it is not known.
    """

    frames: tuple[LocalizedFrame, ...]
    T_map_world: Float64
    seconds: float
    mount: Mount | None = None
    doubts: tuple[str, ...] = ()

    @property
    def tracked(self) -> list[LocalizedFrame]:
        """The frames whose pose the map confirms."""
        return [frame for frame in self.frames if frame.located.state is State.TRACKING]

    @property
    def placed(self) -> list[LocalizedFrame]:
        """The frames whose pose is known: tracked, or coasting for some metres."""
        return [frame for frame in self.frames if frame.located.T_world_camera is not None]

    @property
    def trajectory(self) -> Trajectory:
        """The poses of the frames that are placed, in the world of the map; perhaps none."""
        poses = np.array([frame.located.T_world_camera for frame in self.placed], np.float64)
        times_s = np.array([frame.time_s for frame in self.placed])
        return Trajectory(poses.reshape(-1, 4, 4), times_s)

    def figures(self) -> LocalizedFigures:
        states = [frame.located.state for frame in self.frames]
        seconds = np.array([frame.seconds for frame in self.frames])
        sigmas_m = [frame.located.sigma_m for frame in self.tracked]
        return LocalizedFigures(
            frames=len(states),
            frames_searching=states.count(State.SEARCHING),
            frames_tracking=states.count(State.TRACKING),
            frames_coasting=states.count(State.COASTING),
            frames_lost=states.count(State.LOST),
            first_fix_frame=self.tracked[0].index if self.tracked else None,
            median_sigma_m=float(np.median(sigmas_m)) if sigmas_m else None,
            fps=len(states) / self.seconds if self.seconds > 0 else None,
            seconds_per_frame=FrameSeconds(
                median=float(np.median(seconds)),
                p95=float(np.percentile(seconds, 95)),
                max=float(seconds.max()),
            ),
        )

    def warnings(self) -> list[str]:
        states = [frame.located.state for frame in self.frames]
        lost, coasting = states.count(State.LOST), states.count(State.COASTING)
        if not self.tracked:
            return ["the drive was not found in the map: no frame has a pose"]
        times = "once" if lost == 1 else f"{lost} times"
        of = f"{coasting} of {counted(len(states), 'pose')} rest on odometry alone"
        lines = [f"{of}: they are not confirmed by the map (coasting)"] if coasting else []
        if lost:
            lines += [
                f"localization was lost {times}; frames without a pose are not in the trajectory"
            ]
        return lines


def open_localizer(
    map_: MapFile, config: DriveSettings, *, start: StartPose | None = None
) -> Localizer:
    """Make ready to find a drive in a map, which begins roughly at ``start``; None = anywhere."""
    known, among = known_places(map_), None
    if start is not None:
        among = start.among(map_.first.T_map_world @ known.T_world_camera)
    return Localizer(known, Surroundings(map_, scaled(RANGE_M, config.scale)), among=among)


def localize_sequence(
    source: StereoSource,
    workspace: Workspace,
    config: DriveSettings,
    *,
    start: StartPose | None = None,
    note: Callable[[LocalizedFrame], object] = lambda frame: None,
) -> LocalizedDrive:
    """Find all frames of a source in a map, which is not changed.

    The rig may be another than that of the map; ``start`` is as for `open_localizer`. ``note`` gets
    each frame once it is found or not.
    """
    check_source(source)
    map_, watch = workspace.map, workspace.stopwatch
    config = config.at_scale(map_.first.scale)
    localizer = open_localizer(map_, config, start=start)
    reconstructor = FrameReconstructor(
        source.calibration, config, threads=workspace.threads, stopwatch=watch
    )

    def match(pair: Recorded) -> OdometryFrame:
        if source.live:
            return OdometryFrame(*reconstructor.match_roughly(pair), rough=True)
        return OdometryFrame(*reconstructor.match(pair))

    frames: list[LocalizedFrame] = []
    own, doubts = mount_of(source, config.rectification)
    mount, listener = own or map_.first.mount, workspace.listener
    teller, T_map_world = PoseTeller(mount, config.scale), map_.first.T_map_world
    listener.on_begin(DriveBegun(source, reconstructor.camera, map_.store.path, True, mount))
    base = T_map_world, workspace.camera_height_m or config.ground.camera_height_m
    begun = time.perf_counter()
    stage("localize")
    try:
        with serial_algebra(), series(source.name, len(source)) as shown:
            # What is matched ahead of its turn would be old when it is located.
            pairs = source.frames()
            matched = map(match, pairs) if source.live else look_ahead(match, pairs)
            for index, frame in enumerate(matched):
                if (T_map_base := source.asked_start()) is not None:
                    _restart(localizer, T_map_world, T_map_base @ teller.base(*base))
                with watch.stage("localize"):
                    start_s = time.perf_counter()
                    located = localizer.add(frame, hurried=source.hurried)
                    seconds = time.perf_counter() - start_s
                frames.append(LocalizedFrame(index, frame.pair.timestamp_s, seconds, located))
                note(frames[-1])
                source.note_located(index)
                listener.on_pose(
                    teller.found(frames[-1].time_s, localizer.odometry, located, *base)
                )
                shown.on_step(frames[-1])
                config.memory.check(f"frame {index}")
    finally:
        listener.on_end()
    if not frames:
        raise RegistrationError("the source has no frame", where=source.name)
    seconds = time.perf_counter() - begun
    return LocalizedDrive(tuple(frames), T_map_world, seconds, mount, tuple(doubts))


def _restart(localizer: Localizer, T_map_world: Float64, T_map_camera: Float64) -> None:
    """Look for the drive where somebody says that it is, if the map has views there."""
    try:
        localizer.restart(StartPose.of(T_map_camera).among(T_map_world @ localizer.views))
    except MappingError as error:
        LOGGER.warning("%s; not used", error)


@dataclass(frozen=True, kw_only=True)
class LocalizeSummary(RunSummary):
    """What `recon localize` found."""

    source: str
    map_run: str  # folder of the map, or its file
    T_map_world: Float64  # (4, 4)
    drive: LocalizedFigures = inline()
    rig: RigFigures
    base_frame: str | None = optional()  # of the robot, as its static transforms have it
    read: SourceFigures = inline()

    def rows(self) -> Rows:
        found = self.drive
        tracked = f"{found.frames_tracking} of {counted(found.frames, 'frame')}"
        left = f"{found.frames_coasting} by odometry alone, {found.frames_searching} not yet found"
        first, sigma_m = found.first_fix_frame, found.median_sigma_m
        where = "no frame has a pose" if first is None else f"from frame {first} on"
        sure = "" if sigma_m is None else f", positions ± {metres(sigma_m)}"
        ms = 1e3 * found.seconds_per_frame.p95
        return [
            (f"{tracked} of {self.source} found in {self.map_run}",),
            *self.folder_row(),
            ("poses", "trajectory_tum.txt", where + sure),
            ("others", f"{left}; lost {counted(found.frames_lost, 'time')}"),
            *self.cost_row(f"95 % of frames in {ms:.0f} ms"),
            ("next", self.open_view()),
        ]


@dataclass(frozen=True, eq=False)
class LocalizeResult:
    """Results of a run; the grid is None where that of the map has none."""

    name: str
    map_name: str
    drive: LocalizedDrive
    grid: OccupancyGrid | None
    summary: LocalizeSummary
