"""What a robot is told while it drives, as messages of ROS 2: frames, odometry, pose, map, health.

Frames are those of REP 105: ``map`` (may jump), ``odom`` (never does), ``base_link``, and the
cameras on it. Who writes the messages, a bag or a network, is up to the caller.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from threading import Event, Lock, Thread
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import adjoint, as_step, invert, make_transform, step_covariance
from recon.core.progress import LOGGER
from recon.core.values.arrays import Float64
from recon.export.growing import MapBeside
from recon.io.ros.messages import (
    NS_PER_S,
    Message,
    MessageWriter,
    grid_message,
    header,
    message_types,
    points,
    pose,
    stamp_of,
    transforms,
)
from recon.map.listener import DriveBegun, DriveListener, DrivePose
from recon.map.localize.localizer import State

_EVERY_NS: Final = NS_PER_S  # between two messages of the path, or on health, unless that changes
_MOST_POSES: Final = 300  # in a path: a message of 20 kB, which takes some milliseconds to make
_IDLE: Final = 3.0  # times as long as the last map took is paused before the next one is made
_LEVELS: Final = {
    State.TRACKING: 0, State.COASTING: 1, State.SEARCHING: 1, State.LOST: 2,
}  # fmt: skip


class RobotTopics(DriveListener):
    """Writes topics of a robot while it drives.

    ``/tf``, ``/tf_static`` and ``/diagnostics`` have these names; those of the other topics, and of
    frames but ``map``, begin with ``prefix``. A pose that is not to be trusted is not written: what
    is wrong with it is in ``/diagnostics``. Where writing fails, the drive goes on without.
    ``stamp_ns`` makes stamps of the times of frames; None = they are seconds since 1970.
    """

    def __init__(
        self,
        writers: Sequence[MessageWriter],
        prefix: str = "",
        *,
        stamp_ns: Callable[[float], int] | None = None,
    ) -> None:
        message_types()  # which takes half a second the first time
        self._out = _Guarded(writers)
        name = prefix.strip("/")
        self._topic, self._frame = (f"/{name}/", f"{name}/") if name else ("/", "")
        self._stamp_ns = stamp_ns or stamp_of
        self._map: _MapTopics | None = None
        self._path, self._pathed_ns = _ThinPath(), -_EVERY_NS
        self._T_map_odom: Float64 | None = None
        self._T_odom_world: Float64 | None = None
        self._T_base_camera: Float64 | None = None
        self._before: tuple[int, Float64] | None = None
        self._said_ns, self._said = -_EVERY_NS, State.SEARCHING

    def on_begin(self, begun: DriveBegun) -> None:
        self._begun, mount = begun, begun.mount
        self._base = f"{self._frame}base_link" if mount is None else mount.base
        self._camera = f"{self._frame}left" if mount is None else f"{mount.camera}_rectified"
        if begun.map_path is not None:
            made = MapBeside(begun.map_path, finished=begun.in_map)
            self._map = _MapTopics(self._out, self._topic, made)

    def on_pose(self, found: DrivePose) -> None:
        time_ns = self._stamp_ns(found.time_s)
        if self._map is not None:
            self._map.now(time_ns)
        mounted, self._T_base_camera = self._T_base_camera, found.T_base_camera
        if mounted is None or not np.array_equal(mounted, found.T_base_camera):
            edges = self._mounted(found.T_base_camera)
            self._out.write("/tf_static", time_ns, transforms(time_ns, edges), kept=True)
        T_odom_base = self._follow(found)
        edges = []
        if self._T_map_odom is not None:
            edges.append(("map", f"{self._frame}odom", self._T_map_odom))
        if T_odom_base is not None:
            mount = self._begun.mount
            root = self._base if mount is None else mount.root or mount.base
            T_base_root = np.eye(4) if mount is None else mount.T_base_root
            edges.append((f"{self._frame}odom", root, T_odom_base @ T_base_root))
            odometry = self._odometry(time_ns, found, T_odom_base)
            self._out.write(f"{self._topic}odometry", time_ns, odometry)
        if edges:
            self._out.write("/tf", time_ns, transforms(time_ns, edges))
        self._before = None if T_odom_base is None else (time_ns, T_odom_base)
        T_map_base = found.T_map_base
        if T_map_base is not None and found.covariance is not None:
            spread = _in_parent(_of_base(found.covariance, found.T_base_camera), T_map_base)
            self._place(time_ns, T_map_base, spread)
        if found.state is not self._said or time_ns - self._said_ns >= _EVERY_NS:
            self._said_ns, self._said = time_ns, found.state
            self._out.write("/diagnostics", time_ns, self._health(time_ns, found))

    def on_map(self) -> None:
        if self._map is not None:
            self._map.grown.set()

    def on_end(self) -> None:
        if self._map is not None:
            self._map.end()

    def warnings(self) -> list[str]:
        return [f"topics were written only in part: {error}" for error in self._out.errors]

    def _follow(self, found: DrivePose) -> Float64 | None:
        """Return where the base is in the frame ``odom``, and note where that is in the map.

        A drive that makes a map has both in one place, one in a map begins at the origin of odom.
        """
        T_world_camera = found.T_world_camera
        T_odom_world = self._T_odom_world
        if self._begun.in_map and T_odom_world is None:
            T_odom_world = found.T_base_camera
        if found.T_map_camera is not None:
            T_map_world = found.T_map_camera @ invert(T_world_camera)
            if T_odom_world is None:
                T_odom_world = T_map_world
            self._T_map_odom = T_map_world @ invert(T_odom_world)
        self._T_odom_world = T_odom_world
        if T_odom_world is None or not found.health.ok:
            return None
        return np.asarray(T_odom_world @ T_world_camera @ invert(found.T_base_camera))

    def _mounted(self, T_base_camera: Float64) -> list[tuple[str, str, Float64]]:
        beside = make_transform(np.eye(3), np.array([self._begun.camera.baseline_m, 0.0, 0.0]))
        # Beside a camera of the robot's own, whose right one has a name, too.
        right = f"{self._frame}right" + ("" if self._begun.mount is None else "_rectified")
        return [(self._base, self._camera, T_base_camera), (self._camera, right, beside)]

    def _odometry(self, time_ns: int, found: DrivePose, T_odom_base: Float64) -> Message:
        speed, unsure = np.zeros(6), np.zeros((6, 6))
        unsure[0, 0] = -1.0  # as ROS says that something is not known
        health = found.health
        before_ns, T_odom_before = self._before or (time_ns, T_odom_base)
        passed_s = (time_ns - before_ns) / NS_PER_S
        if passed_s > 0 and not health.begins and math.isfinite(health.sigma_m):
            speed = as_step(invert(T_odom_before) @ T_odom_base) / passed_s
            off = step_covariance(health.sigma_m, health.sigma_deg) / passed_s**2
            unsure = _of_base(off, found.T_base_camera)
        parts = (dict(zip("xyz", part.tolist(), strict=True)) for part in (speed[:3], speed[3:]))
        spread = _in_parent(_of_base(found.drift, found.T_base_camera), T_odom_base)
        return "nav_msgs/msg/Odometry", {
            "header": header(f"{self._frame}odom", time_ns),
            "child_frame_id": self._base,
            "pose": {"pose": pose(T_odom_base), "covariance": spread.ravel()},
            "twist": {
                "twist": dict(zip(("linear", "angular"), parts, strict=True)),
                "covariance": unsure.ravel(),
            },
        }

    def _place(self, time_ns: int, T_map_base: Float64, spread: Float64) -> None:
        """Write where the robot is in the map, and now and then where it was."""
        placed = {"pose": pose(T_map_base), "covariance": spread.ravel()}
        content = {"header": header("map", time_ns), "pose": placed}
        message = "geometry_msgs/msg/PoseWithCovarianceStamped", content
        self._out.write(f"{self._topic}pose", time_ns, message)
        self._path.add(time_ns, T_map_base)
        if time_ns - self._pathed_ns >= _EVERY_NS:
            self._pathed_ns = time_ns
            self._out.write(f"{self._topic}path", time_ns, self._path.message(time_ns))

    def _health(self, time_ns: int, found: DrivePose) -> Message:
        live = self._begun.source.figures().live
        known: dict[str, Any] = {"state": found.state.value, "inliers": found.health.inliers}
        if found.trusted:
            known["sigma_m"] = round(found.sigma_m, 4)
        if live is not None:
            known |= {name: getattr(live, name) for name in _COUNTED}
            known |= {f"latency_{name}_ms": of for name, of in vars(live.latency_ms).items()}
        map_note = "" if self._map is None else self._map.note
        if map_note:
            known["map"] = map_note
        status = {
            "level": max(_LEVELS[found.state], int(bool(map_note))),
            "name": f"{self._frame}recon",
            "message": found.note or found.state.value,
            "hardware_id": self._begun.source.name,
            "values": [{"key": key, "value": str(value)} for key, value in known.items()],
        }
        content = {"header": header("", time_ns), "status": [status]}
        return "diagnostic_msgs/msg/DiagnosticArray", content


_COUNTED: Final = ("frames_arrived", "frames_dropped", "frames_not_matched")


def _of_base(covariance: Float64, T_base_camera: Float64) -> Float64:
    """Return the covariance (6, 6) of a step of the base, in its axes, of one of the camera."""
    turn = adjoint(T_base_camera)
    return np.asarray(turn @ covariance @ turn.T)


def _in_parent(covariance: Float64, T_parent_base: Float64) -> Float64:
    """Return the covariance (6, 6) of a pose in the axes of its parent, as ROS has it."""
    turn = np.kron(np.eye(2), T_parent_base[:3, :3])
    return np.asarray(turn @ covariance @ turn.T)


class _ThinPath:
    """A path of a bounded number of poses, the more apart the longer it is."""

    def __init__(self) -> None:
        self._places_m: list[Float64] = []
        self._poses: list[dict[str, Any]] = []  # as they are in messages
        self._spacing_m = 0.0

    def add(self, time_ns: int, T_map_base: Float64) -> None:
        place_m = T_map_base[:3, 3]
        if self._poses and np.linalg.norm(place_m - self._places_m[-1]) < self._spacing_m:
            return
        self._places_m.append(place_m)
        self._poses.append({"header": header("map", time_ns), "pose": pose(T_map_base)})
        if len(self._poses) > _MOST_POSES:
            self._poses, self._places_m = self._poses[::2], self._places_m[::2]
            steps_m = np.linalg.norm(np.diff(self._places_m, axis=0), axis=1)
            self._spacing_m = float(steps_m.mean())

    def message(self, time_ns: int) -> Message:
        return "nav_msgs/msg/Path", {"header": header("map", time_ns), "poses": self._poses}


class _Guarded:
    """Writes messages of several threads, each writer until it fails, which is said once."""

    def __init__(self, writers: Sequence[MessageWriter]) -> None:
        self._writers, self._lock = [*writers], Lock()
        self.errors = list[BaseException]()

    def write(self, topic: str, time_ns: int, message: Message, *, kept: bool = False) -> None:
        with self._lock:
            one = topic, time_ns, message
            self._writers = [to for to in self._writers if self._written(to, *one, kept=kept)]

    def _written(
        self, writer: MessageWriter, topic: str, time_ns: int, message: Message, *, kept: bool
    ) -> bool:
        try:
            writer.write(topic, time_ns, message, kept=kept)
        except Exception as error:  # noqa: BLE001 - of any writer; a map is not lost for it
            self.errors.append(error)
            LOGGER.warning("topics are not written any more: %s", error)
            return False
        return True


class _MapTopics:
    """Writes the map as it grows, which is made a fraction of the time."""

    def __init__(self, out: _Guarded, topic: str, growing: MapBeside) -> None:
        self._out, self._topic, self._growing, self._now_ns = out, topic, growing, -1
        self.note = ""
        self.grown, self._over = Event(), Event()
        self._thread = Thread(target=self._work, name="map-topics", daemon=True)
        self._thread.start()

    def now(self, time_ns: int) -> None:
        """Note the time of the drive; a map that is there is written when that is known."""
        first, self._now_ns = self._now_ns < 0, time_ns
        if first and self._growing.finished:
            self.grown.set()

    def end(self) -> None:
        """Write the last of it."""
        self._over.set()
        self.grown.set()
        self._thread.join()
        self._growing.close()

    def _work(self) -> None:
        over = False
        while not over:
            self.grown.wait()
            self.grown.clear()
            over, begun_s = self._over.is_set(), time.monotonic()
            try:
                self._write()
            except Exception as error:  # noqa: BLE001 - said in diagnostics; poses go on
                self.note = str(error)
            self._over.wait(_IDLE * (time.monotonic() - begun_s))

    def _write(self) -> None:
        time_ns, name, new = self._now_ns, self._topic, self._growing.update()
        if new is None or time_ns < 0:
            return
        self.note = new.note
        self._out.write(f"{name}map", time_ns, grid_message(time_ns, new.grid), kept=True)
        if new.costs is not None:
            costs = grid_message(time_ns, new.costs)
            self._out.write(f"{name}costmap", time_ns, costs, kept=True)
        if len(new.cloud):
            cloud = points(header("map", time_ns), new.cloud)
            self._out.write(f"{name}cloud", time_ns, cloud, kept=self._growing.finished)
