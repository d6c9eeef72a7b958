"""Map with a RealSense D400 while it moves: `pip install pyrealsense2` (written for 2.59).

    python examples/06_realsense.py [FOLDER]

Until Ctrl-C. Names are checked against the package; it was not run on a device.
"""

from __future__ import annotations

import sys

import numpy as np
import pyrealsense2 as rs

import recon

WIDTH_PX, HEIGHT_PX, FPS = 848, 480, 15


def calibration_of(profile: rs.pipeline_profile) -> recon.RectifiedCamera:
    """Return the calibration of the infrared images, which the device rectifies."""
    left, right = (
        profile.get_stream(rs.stream.infrared, side).as_video_stream_profile() for side in (1, 2)
    )
    of_left, of_right = left.get_intrinsics(), right.get_intrinsics()
    baseline_m = float(np.linalg.norm(left.get_extrinsics_to(right).translation))
    centre_px = of_left.ppx, of_left.ppy, of_right.ppx
    return recon.RectifiedCamera(of_left.fx, *centre_px, baseline_m, WIDTH_PX, HEIGHT_PX)


def main(folder: str) -> None:
    """Push pairs until Ctrl-C, which completes the map."""
    pipeline, wanted = rs.pipeline(), rs.config()
    for side in (1, 2):
        wanted.enable_stream(rs.stream.infrared, side, WIDTH_PX, HEIGHT_PX, rs.format.y8, FPS)
    profile = pipeline.start(wanted)
    # Its dots move with the camera, and features must not.
    profile.get_device().first_depth_sensor().set_option(rs.option.emitter_enabled, 0)
    with recon.LiveMap(calibration_of(profile), out=folder) as live:
        try:
            while True:
                frames = pipeline.wait_for_frames()
                left, right = (
                    np.asarray(frames.get_infrared_frame(side).get_data()) for side in (1, 2)
                )
                live.push(left, right, frames.get_timestamp() / 1000)
                print(live.pose)
        except KeyboardInterrupt:
            print("completing the map")
        finally:
            pipeline.stop()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "outputs/examples/realsense")
