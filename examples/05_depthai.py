"""Map with an OAK camera of Luxonis while it moves: `pip install depthai` (written for 3.12).

    python examples/05_depthai.py [FOLDER]

Until Ctrl-C. Types and names are checked against the package; it was not run on a device.
"""

from __future__ import annotations

import sys
from datetime import timedelta
from typing import Any

import depthai as dai
import numpy as np

import recon

SIZE, FPS = (640, 400), 15
SOCKETS = {"left": dai.CameraBoardSocket.CAM_B, "right": dai.CameraBoardSocket.CAM_C}


def calibration_of(device: dai.Device) -> recon.StereoCalibration:
    """Return what the device keeps of its two grey cameras, for images of SIZE."""
    kept = device.readCalibration()
    left, right = (
        recon.CameraIntrinsics(
            np.array(kept.getCameraIntrinsics(socket, *SIZE)),
            np.array(kept.getDistortionCoefficients(socket)),
            *SIZE,
        )
        for socket in SOCKETS.values()
    )
    sockets, metres = (SOCKETS["left"], SOCKETS["right"]), dai.LengthUnit.METER
    T_right_left = kept.getCameraExtrinsics(*sockets, useSpecTranslation=False, unit=metres)
    return recon.StereoCalibration(left, right, np.array(T_right_left))


def main(folder: str) -> None:
    """Push pairs until Ctrl-C, which completes the map."""
    with dai.Pipeline() as pipeline:
        both = pipeline.create(dai.node.Sync)
        both.setSyncThreshold(timedelta(seconds=0.5 / FPS))
        for side, socket in SOCKETS.items():
            camera = pipeline.create(dai.node.Camera).build(socket)
            # As it was taken: recon rectifies, and knows how sure it is of what it rectified.
            grey = dai.ImgFrame.Type.GRAY8
            images = camera.requestOutput(SIZE, grey, fps=FPS, enableUndistortion=False)
            images.link(both.inputs[side])
        pairs = both.out.createOutputQueue(maxSize=2, blocking=False)
        calibration = calibration_of(pipeline.getDefaultDevice())
        pipeline.start()
        with recon.LiveMap(calibration, out=folder) as live:
            try:
                while pipeline.isRunning():
                    pair: Any = pairs.get()  # a MessageGroup of two ImgFrames
                    left, right = pair["left"], pair["right"]
                    time_s = left.getTimestamp().total_seconds()
                    live.push(left.getCvFrame(), right.getCvFrame(), time_s)
                    print(live.pose)
            except KeyboardInterrupt:
                print("completing the map")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "outputs/examples/depthai")
