"""Settings of the odometries."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, InstanceOf, field_serializer

from recon.core.plugins import name_of
from recon.core.settings import Settings
from recon.odometry.protocol import Odometry


class PriorSettings(Settings):
    """How a path from other sensors is used (`recon map --prior`)."""

    axes: Literal["auto", "camera", "body"] = "auto"
    """Axes of its poses: of the left camera (x right, y down, z forward), or of a body (x forward,
    y left, z up) that turns with it and is near to it. auto = those in which it explains what
    the cameras see on the first metres."""
    sigma_m: float = Field(0.03, ge=1e-06, le=1000000.0)
    """Standard deviation of its motion from frame to frame. State here what your sensor is worth:
    the cameras are believed where it is worse."""
    sigma_ratio: float = Field(0.03, ge=0.0, le=1000.0)
    """Fraction of the motion's length that is added to `sigma_m`."""
    sigma_deg: float = Field(0.5, ge=1e-06, le=360.0)
    """Standard deviation of its rotation from frame to frame."""


class RigSettings(Settings):
    """Whether the calibration is refined by what the motion of a drive shows."""

    refine: bool = True
    """Use the rig as the drive shows it, or an earlier drive of its map: how the right camera is
    turned, its focal length, and what both lenses bend. off = the calibration as it is: what
    the drive shows is only said."""


class OdometrySettings(Settings):
    """Where the camera is in each frame."""

    method: str | InstanceOf[Odometry] = "visual"
    """visual = features followed from frame to frame; kiss = kiss-icp, which from there registers
    the points that stereo measures well over time, to compare with; sfm = structure from motion by
    COLMAP over all pairs, in any order (extra sfm); or one that an installed package registers;
    in Python also an odometry of your own."""
    imu: bool = True
    """Use the inertial unit of a source that has one, without `--prior`: its gyro says how the
    camera turns, also where it sees nothing, its accelerometer what is up. Its bias, delay and axes
    are found from the drive."""
    prior: PriorSettings = PriorSettings()

    @field_serializer("method")
    def _written(self, method: str | Odometry) -> str:
        return name_of(method)
