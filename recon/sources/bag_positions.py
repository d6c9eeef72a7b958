"""Measured positions in recordings: messages ``sensor_msgs/NavSatFix`` of a receiver."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.core.errors import SourceError
from recon.io.cameras.ros import NS
from recon.io.positions import Positions, in_order, read_positions
from recon.sources.bag import BAGS, find_bags, recording_files
from recon.sources.rosbags import FIX, Bag


def read_measured(path: Path) -> Positions:
    """Read positions of a recording, ``BAG`` or ``BAG:/TOPIC``, or of a file (`read_positions`).

    Messages without a fix are left out; deviations are those of the covariance, NaN where it is
    unknown. Times are those of the headers, of recording where these have none.

    Raises:
        ReconError: The file or topic is missing, damaged or without positions; or the recording has
            several receivers, and no topic is named.

    Ref: ROS, ``sensor_msgs/NavSatFix``; heights are above the ellipsoid of WGS 84.
    """
    name, _, topic = str(path).partition(":/")
    place = Path(name)
    if place.suffix not in BAGS and not (place.is_dir() and find_bags(place)):
        return read_positions(path)
    bag = Bag(recording_files(place))
    known = [one.name for one in bag.topics.values() if one.kind == FIX and one.messages]
    chosen = [f"/{topic}"] if topic else known
    if len(chosen) != 1 or chosen[0] not in known:
        what = "several receivers" if len(chosen) > 1 else "no positions of a receiver"
        got = bag.list_topics((FIX,)) or "no NavSatFix among " + (", ".join(bag.topics) or "none")
        hint = f"name one: {place}:{known[0]}" if known else None
        raise SourceError(f"the recording has {what}", where=path, got=got, hint=hint)
    table = bag.fixes(chosen[0])
    times_ns = np.where((table[:, 1] > 0).all(), table[:, 1], table[:, 0])
    fixed = table[:, 2] >= 0
    positions = Positions(
        times_s=np.where(fixed, times_ns * NS, np.nan),
        places=table[:, 3:6],
        sigma_m=table[:, 6:],
        degrees=True,
        heights="the ellipsoid",
    )
    return in_order(positions, path)
