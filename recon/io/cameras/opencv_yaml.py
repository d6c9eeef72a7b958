"""OpenCV's stereo calibration: YAML, XML or JSON as written by ``cv2.FileStorage``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.values import StereoCalibration
from recon.io.atomic import write_text
from recon.io.files import StrPath


def write_opencv_calibration(path: StrPath, calibration: StereoCalibration) -> None:
    """Write one file for OpenCV's ``FileStorage``: XML or JSON where it is named so, else YAML."""
    models = {calibration.left.model, calibration.right.model}
    if len(models) > 1:
        raise CalibrationError("an OpenCV file cannot store two lens models", where=path)
    if models - {"pinhole", "fisheye"}:
        what = "an OpenCV file cannot store this lens model"
        raise CalibrationError(what, where=path, got=calibration.left.model)
    suffix = Path(path).suffix.lower()
    kind = suffix if suffix in {".xml", ".json"} else ".yml"
    storage = cv2.FileStorage(kind, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", calibration.left.width_px)
    storage.write("image_height", calibration.left.height_px)
    if "fisheye" in models:
        storage.write("distortion_model", "fisheye")
    for number, camera in enumerate((calibration.left, calibration.right), start=1):
        storage.write(f"M{number}", np.array(camera.matrix))
        storage.write(f"D{number}", np.array(camera.distortion).reshape(1, -1))
    storage.write("R", np.array(calibration.T_right_left[:3, :3]))
    storage.write("T", np.array(calibration.T_right_left[:3, 3]).reshape(3, 1))
    write_text(path, storage.releaseAndGetString())
