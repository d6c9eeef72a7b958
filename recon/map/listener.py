"""Who is told of a drive while it goes on: robots, and programs in Python."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from recon.core.geometry.se3 import invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.map.ground.axes import base_axes
from recon.map.localize.localizer import Located, State
from recon.odometry.checked import SegmentCounter
from recon.odometry.protocol import OdometryHealth, OdometryResult
from recon.places.closure import USUAL
from recon.places.places import path_lengths, spread_over
from recon.sources.source import Mount, StereoSource


@dataclass(frozen=True, eq=False)
class DriveBegun:
    """A drive of which nothing is known yet."""

    source: StereoSource
    camera: RectifiedCamera
    map_path: Path | None  # file of the map; None = it is in memory
    in_map: bool  # whether the drive is found in a map that is there; else one is made
    mount: Mount | None = None  # where the rectified left camera is on the robot, if that is known


@dataclass(frozen=True, eq=False)
class DrivePose:
    """Where the left camera was in a frame, as soon as that is known.

    Covariances are float64 (6, 6) of a step (translation in metres, rotation vector in radians) in
    camera axes.
    """

    time_s: float
    # float64 (4, 4), by odometry alone, which nothing corrects; as the axes of the first frame
    T_world_camera: Float64
    T_base_camera: Float64  # (4, 4)
    drift: Float64  # covariance by what odometry drifts since the first frame
    health: OdometryHealth  # of the step from the frame before
    state: State
    T_map_camera: Float64 | None = None  # float64 (4, 4); None = not known, or not to be trusted
    covariance: Float64 | None = None  # of it
    note: str = ""  # why it is not known, or not confirmed

    @property
    def trusted(self) -> bool:
        """Whether it is known where in the map the camera is."""
        return self.T_map_camera is not None

    @property
    def T_map_base(self) -> Float64 | None:
        """float64 (4, 4), of the base of the robot: its origin, on the ground if that was seen."""
        T = self.T_map_camera
        return None if T is None else np.asarray(T @ invert(self.T_base_camera))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position, of its three axes together; NaN where unknown."""
        return Located(self.state, covariance=self.covariance).sigma_m

    def __repr__(self) -> str:
        parts = [f"{self.time_s:.2f} s", self.state.value, *([self.note] if self.note else [])]
        if self.T_map_camera is not None:
            at = " ".join(f"{metres:.5g}" for metres in self.T_map_camera[:3, 3])
            parts.append(f"at {at} m, sigma {self.sigma_m:.2g} m")
        return f"DrivePose({', '.join(parts)})"


class DriveListener(Protocol):
    """Is told of a drive while it goes on; what is not overridden does nothing."""

    def on_begin(self, begun: DriveBegun) -> None:
        return

    def on_pose(self, pose: DrivePose) -> None:
        """Hear where a frame is, in the thread of the poses: what takes long delays them."""
        return

    def on_map(self) -> None:
        """Hear that the file of the map has grown, in the thread that maps."""
        return

    def on_end(self) -> None:
        """Hear that the frames are over; unless by an error, all of the map is in its file."""
        return

    def warnings(self) -> list[str]:
        """Return what the user should know of it, in words."""
        return []


class _Nobody(DriveListener):
    """Wants to know nothing."""

    def __repr__(self) -> str:
        return "NOBODY"


NOBODY: Final = _Nobody()


@dataclass
class PoseTeller:
    """Makes of poses by odometry what a listener is told, and counts how far they may be off."""

    mount: Mount | None
    scale: float = 1.0
    _segments: SegmentCounter = field(default_factory=SegmentCounter)
    _before: Float64 | None = None
    _path_m: float = 0.0
    _variance: Float64 = field(default_factory=lambda: np.zeros(2))

    def mapped(
        self,
        time_s: float,
        T_world_camera: Float64,
        health: OdometryHealth,
        T_map_world: Float64,
        camera_height_m: float | None,
    ) -> DrivePose:
        """Return a pose of a drive that makes a map. Behind a break it has no place there."""
        T_base_camera = self.base(T_map_world, camera_height_m)
        self._segments.add(health)
        drift = self._drifted(T_world_camera, health)
        what = (time_s, T_world_camera, T_base_camera, drift, health)
        note = "; ".join(health.notes)
        if self._segments.number:
            note = note or "odometry was lost; nothing says where the drive goes on in the map"
            return DrivePose(*what, State.LOST, note=note)
        if not health.ok:
            return DrivePose(*what, State.COASTING, note=note)
        return DrivePose(*what, State.TRACKING, T_map_world @ T_world_camera, drift, note)

    def found(
        self,
        time_s: float,
        odometry: OdometryResult,
        located: Located,
        T_map_world: Float64,
        camera_height_m: float | None,
    ) -> DrivePose:
        """Return a pose of a drive that is found in a map."""
        T_base_camera, T = self.base(T_map_world, camera_height_m), located.T_world_camera
        T_world_camera, health = odometry.T_world_camera, odometry.health
        drift = self._drifted(T_world_camera, health)
        what = (time_s, T_world_camera, T_base_camera, drift, health)
        T_map_camera = None if T is None else T_map_world @ T
        return DrivePose(*what, located.state, T_map_camera, located.covariance, located.note)

    def base(self, T_map_world: Float64, camera_height_m: float | None) -> Float64:
        """Return ``T_base_camera`` (4, 4): as mounted, else by the height above the ground."""
        return base_axes(T_map_world, camera_height_m, self.mount)

    def _drifted(self, T_world_camera: Float64, health: OdometryHealth) -> Float64:
        trusted: Bool = np.array([True, health.ok])
        before = T_world_camera if self._before is None else self._before
        steps = np.stack([before, T_world_camera])
        self._before = T_world_camera
        self._path_m += float(path_lengths(steps, trusted, self.scale)[-1])
        sigma = np.array([health.sigma_m, np.deg2rad(health.sigma_deg)])
        self._variance += np.nan_to_num(sigma, posinf=0.0) ** 2
        drift = np.concatenate(spread_over(np.array([self._path_m]), self.scale))
        return np.diag(np.repeat((USUAL * drift) ** 2 + self._variance, 3))
