"""From frames to poses: visual odometry, or kiss-icp to compare with.

- `protocol.py`: what every odometry takes and gives; `registry.py`: the odometries by name;
- `visual.py`: features tracked (`tracking.py`) through a short window of frames (`window.py`);
- `kiss.py`: clouds registered over time by `kiss_icp.py`, which also registers in a finished map
  (`recon.map.localize`);
- `checked.py`: poses that cannot be trusted are marked, by all patches of the image
  (`agreement.py`); `health.py`: what that says of a drive; `path_drift.py`: how far it may be off;
- `prior.py`: what wheels or an inertial unit say; `prior_axes.py`: in which axes they say it.
"""

from recon.odometry.known_poses import KnownPoses
from recon.odometry.path_drift import ExpectedDrift, expected_drift
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
