"""From frames to poses: visual odometry, corrected by kiss-icp where that helps."""

from recon.odometry.known import KnownPoses
from recon.odometry.prior import MotionPrior
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryHealth, OdometryResult
from recon.odometry.registry import ODOMETRIES, make_odometry
from recon.odometry.settings import OdometrySettings

__all__ = [
    "ODOMETRIES",
    "KnownPoses",
    "MotionPrior",
    "Odometry",
    "OdometryFrame",
    "OdometryHealth",
    "OdometryResult",
    "OdometrySettings",
    "make_odometry",
]
