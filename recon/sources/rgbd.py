"""Folders of a camera with depth, in the layout of TUM's RGB-D benchmark.

::

    folder/
      rgb.txt depth.txt      time [s] and file per line
      rgb/ depth/            images; depth as 16-bit PNG, along the optical axis, 0 = unknown
      groundtruth.txt        optional: t tx ty tz qx qy qz qw of the camera
      calib.txt              any calibration file of rectified cameras; or none, with --focal

Depth is that of the pixels of the image, which has no lens distortion. It becomes the disparity of
a Kinect, unless another baseline is given.

Ref: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Khoshelham and
Oude Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping applications",
Sensors 2012.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import CalibrationError, FormatError, SettingsError
from recon.core.values import Disparity, RectifiedCamera, RectifiedImage, Rig, check_size
from recon.core.values.camera import disparity_from_depth
from recon.io.images.image import read_grey_levels
from recon.sources.images import ImageSource
from recon.sources.listed import open_tum
from recon.sources.settings import SourceSettings

DEPTH: Final = "depth.txt"
_TOLERANCE_S: Final = 0.02  # that of TUM's own tool: image and depth are not triggered together
_KINECT_M: Final = 0.075  # from its projector to its infrared camera
_KINECT_PX: Final = 1 / 16  # standard deviation of its disparities: half of their step
_ROUNDED: Final = 12**-0.5  # standard deviation of what was rounded, in steps


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class DepthSource(ImageSource):
    """A drive of a camera with depth; the right image of a frame is that of its depth."""

    stereo = False
    calibration: RectifiedCamera
    per_metre: float  # value of a metre of depth

    def __post_init__(self) -> None:
        rig: Rig = self.calibration
        if not isinstance(rig, RectifiedCamera):
            what, hint = "the calibration is of raw cameras", "take the lens out of image and depth"
            raise CalibrationError(what, where=self.name, expected="rectified", hint=hint)

    def frames(self, start: int = 0) -> Iterator[RectifiedImage]:
        camera = self.calibration
        for index, frame in enumerate(self.images[start:], start):
            image, levels = self._read(frame.left), read_grey_levels(frame.right)
            check_size(camera, levels.shape[1], levels.shape[0], frame.right)
            if levels.dtype != np.uint16:
                what, got = "not an image of depth", levels.dtype.name
                raise FormatError(what, where=frame.right, got=got, expected="16 bits")
            grey, rgb = image, None
            if image.ndim == 3:
                grey, rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)), image
            disparity, when = disparity_of(levels, self.per_metre, camera), frame.timestamp_s
            yield RectifiedImage(grey, disparity, camera, rgb, timestamp_s=when, index=index)


def disparity_of(levels: NDArray[Any], per_metre: float, camera: RectifiedCamera) -> Disparity:
    """Return the disparity of uint16 (H, W), 0 = unknown, as sure as that of a Kinect."""
    values = disparity_from_depth(levels / per_metre, camera)
    step_px = (values + np.float32(camera.doffs_px)) / np.maximum(levels, 1)
    return Disparity.from_values(values, sigma_px=np.hypot(_KINECT_PX, _ROUNDED * step_px))


def open_rgbd(folder: Path, settings: SourceSettings) -> ImageSource:
    """Open a folder of images and depth, each image with the depth that is nearest in time."""
    settings.refuse_names(("left", "right"), folder, "its lists are rgb.txt and depth.txt")
    if settings.length is not None:
        what = "depth that was recorded has a scale of its own, which no measured length changes"
        raise SettingsError(what, where="--length")
    update: dict[str, Any] = {"left": "rgb.txt", "right": DEPTH}
    update["tolerance_s"] = max(settings.tolerance_s, _TOLERANCE_S)
    if settings.focal_px is not None and settings.baseline_m is None:
        update["baseline_m"] = _KINECT_M
    make = partial(DepthSource, per_metre=settings.depth_per_metre)
    return open_tum(folder, settings.model_copy(update=update), make)
