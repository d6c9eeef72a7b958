"""From frames to poses: visual odometry, corrected by kiss-icp where that helps."""

from recon.odometry.expected import ExpectedDrift, expected_drift
from recon.odometry.known import KnownPoses
from recon.odometry.prior import MotionPrior
from recon.odometry.prior_axes import FoundAxes, find_axes, first_moving
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryHealth, OdometryResult
from recon.odometry.registry import ODOMETRIES, make_odometry
from recon.odometry.settings import OdometrySettings, PriorSettings

__all__ = [
    "ODOMETRIES",
    "ExpectedDrift",
    "FoundAxes",
    "KnownPoses",
    "MotionPrior",
    "Odometry",
    "OdometryFrame",
    "OdometryHealth",
    "OdometryResult",
    "OdometrySettings",
    "PriorSettings",
    "expected_drift",
    "find_axes",
    "first_moving",
    "make_odometry",
]
