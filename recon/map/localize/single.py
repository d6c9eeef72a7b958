"""Where a single pair was taken in a map."""

from __future__ import annotations

from recon.core.values import RectifiedCamera, StereoCalibration, StereoPair
from recon.map.localize.localizer import Localizer, Located
from recon.map.settings import DriveSettings
from recon.map.store.map import Map
from recon.map.store.views import known_places
from recon.odometry import OdometryFrame
from recon.stereo.frame import FrameReconstructor


def locate_pair(
    map_: Map,
    pair: StereoPair,
    calibration: RectifiedCamera | StereoCalibration | None,
    config: DriveSettings | None,
) -> Located:
    """Return where a pair was taken; see `Map.localize`.

    Several views of the map must show the place, since no second frame confirms it.

    Raises:
        ReconError: The map has no keyframes or is damaged, or images and calibration do not fit
            together.
    """
    known = known_places(map_)
    camera = calibration or map_.first.camera
    frame = OdometryFrame(*FrameReconstructor(camera, config or DriveSettings()).match(pair))
    return Localizer(known, frames=1).add(frame)
