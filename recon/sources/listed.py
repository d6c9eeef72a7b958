"""Drives with a list of images and times for each camera: EuRoC (ASL, TUM VI), TUM, and RGB-D.

::

    folder/                            TUM
      left.txt right.txt               time [s] and file per line (or cam0.txt cam1.txt …)
      left/1305031102.175304.png …
      groundtruth.txt                  optional: t tx ty tz qx qy qz qw of the left camera
      calib.txt                        or any other supported calibration file

    folder/                            RGB-D, as TUM's benchmark has it
      rgb.txt depth.txt                as above; depth is 16-bit PNG, along the axis, 0 = unknown
      calib.txt                        of rectified cameras; or none, with --focal

    folder/mav0/                       EuRoC (or its content directly)
      cam0/ cam1/
        data.csv                       time [ns], file name
        data/1403636579763555584.png
        sensor.yaml                    lens, size, T_BS (or a camchain for both cameras)
      imu0/                            optional: the inertial unit
        data.csv                       time [ns], rates [rad/s], forces [m/s²]
        sensor.yaml                    T_BS
      state_groundtruth_estimate0/     optional: ground truth trajectory of the body (or mocap0)
        data.csv

Depth is that of the pixels of the image, without lens distortion. It becomes the disparity of a
Kinect, unless another baseline is given.

Ref: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Khoshelham and
Oude Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping applications",
Sensors 2012.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import CalibrationError, FormatError, SettingsError, SourceError
from recon.core.geometry.se3 import invert
from recon.core.values import (
    Disparity,
    ImuRecord,
    RectifiedCamera,
    RectifiedImage,
    Rig,
    SequenceTruth,
    StereoCalibration,
    check_size,
)
from recon.core.values.arrays import Float64
from recon.core.values.camera import disparity_from_depth
from recon.io.cameras.named import read_euroc_camera
from recon.io.cameras.ros import NS, read_euroc_truth
from recon.io.files import resolved
from recon.io.images.image import read_grey_levels
from recon.io.imu import read_axes, read_imu, read_kalibr_imu
from recon.sources.calibration import as_rectified, find_calibration, read_rig
from recon.sources.images import (
    ImageSource,
    find_partners,
    image_size,
    is_image,
    pair_listed,
    stamps_of,
)
from recon.sources.settings import SourceSettings
from recon.sources.times import check_seconds, read_stamped_names, read_tum_truth, truth_at

_IMU: Final = "imu0"
_TRUTHS: Final = "state_groundtruth_estimate0", "mocap0"  # of EuRoC, and of TUM VI


def open_tum(
    folder: Path, settings: SourceSettings, make: Callable[..., ImageSource] = ImageSource
) -> ImageSource:
    """Open a drive with two lists; its images are paired by timestamp."""
    paths = _find_lists(folder, settings)
    lists = []
    for path in paths:
        entries = read_stamped_names(path)
        check_seconds(np.array([stamp for stamp, _ in entries]), path)
        lists.append([(stamp, path.parent / name) for stamp, name in entries])
    frames, listing = pair_listed(lists, settings, folder)
    rig, texts = read_rig(settings, folder, image_size(frames[0].left, settings))
    truth, note = read_tum_truth(folder, stamps_of(frames))
    return make(
        name=resolved(folder).name,
        description=f"TUM drive, {paths[0].name} and {paths[1].name}, "
        f"paired by stamps{listing}{note}",
        calibration=rig,
        images=frames,
        listing=listing,
        truth=truth,
        truth_of_raw=True,
        texts=(*texts, *paths),
    )


def list_files(folder: Path) -> list[tuple[str, str]]:
    """Return names (left, right) of the text files in a folder that list images."""
    names = [
        path.name
        for path in folder.iterdir()
        if path.suffix == ".txt" and path.is_file() and _lists(path)
    ]
    return find_partners(names)


def _lists(path: Path) -> bool:
    """Return whether a file is a list, by its first entry: a number, then the name of an image."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        words = next((line.split() for line in lines if line.strip() and line[0] != "#"), [])
    return len(words) >= 2 and is_image(Path(words[1]))


def _find_lists(folder: Path, settings: SourceSettings) -> tuple[Path, Path]:
    if (named := settings.named_in(folder)) is not None:
        return named
    found = list_files(folder)
    if not found:
        what = "folder has no image lists of two cameras"
        expected, hint = "left.txt and right.txt, or similar", "name them with --left and --right"
        raise SourceError(what, where=folder, expected=expected, hint=hint)
    return folder / found[0][0], folder / found[0][1]


def is_euroc(folder: Path) -> bool:
    """Return whether a folder has the list of EuRoC's left camera."""
    return (_root(folder) / "cam0" / "data.csv").is_file()


def _root(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def open_euroc(folder: Path, settings: SourceSettings) -> ImageSource:
    """Open a drive; its images are paired by timestamp, its ground truth is interpolated."""
    root = _root(folder)
    views = [root / (settings.left or "cam0"), root / (settings.right or "cam1")]
    lists = []
    for view in views:
        if not view.is_dir():
            raise SourceError("folder of a camera is missing", where=view)
        entries = read_stamped_names(view / "data.csv", unit_s=NS)
        lists.append([(stamp, view / "data" / name) for stamp, name in entries])
    frames, listing = pair_listed(lists, settings, root)
    rig, texts = _read_euroc_rig(root, settings, views, image_size(frames[0].left, settings))
    truth, note = _read_euroc_truth(root, views[0], stamps_of(frames))
    return ImageSource(
        name=resolved(folder).name,
        description=f"EuRoC drive, {views[0].name} and {views[1].name}, paired by stamps{listing}"
        f"{note}",
        calibration=rig,
        images=frames,
        listing=listing,
        truth=truth,
        truth_of_raw=True,
        texts=(*texts, *(view / "data.csv" for view in views), *_imu_files(root)),
        imu=partial(_read_imu, root, views[0]) if _imu_files(root) else None,
    )


def _read_euroc_rig(
    root: Path, settings: SourceSettings, views: list[Path], size: tuple[int, int]
) -> tuple[Rig, tuple[Path, ...]]:
    paths = [view / "sensor.yaml" for view in views]
    if settings.has_camera or not paths[0].is_file():
        chain = _chain(root)
        return read_rig(settings, root if chain is None else chain.parent, size)
    (left, T_body_left), (right, T_body_right) = (read_euroc_camera(path) for path in paths)
    rig = StereoCalibration(left, right, invert(T_body_right) @ T_body_left)
    check_size(rig, *size, paths[0])
    return as_rectified(rig), tuple(paths)


def _imu_files(root: Path) -> list[Path]:
    """Return the files of the inertial unit; empty = there is none."""
    files = [root / _IMU / name for name in ("data.csv", "sensor.yaml")]
    return [path for path in files if path.is_file()] if files[0].is_file() else []


def _read_imu(root: Path, left: Path) -> ImuRecord:
    record = read_imu(root / _IMU / "data.csv")
    sensor = root / _IMU / "sensor.yaml"
    T_camera_imu, note = read_axes(sensor, left / "sensor.yaml", _chain(root))
    notes = (*record.notes, note) if note else record.notes
    return replace(record, T_camera_imu=T_camera_imu, notes=notes)


def _chain(root: Path) -> Path | None:
    """Return the file for both cameras: TUM VI has it beside mav0 or in another folder there."""
    found = map(find_calibration, (root, root.parent, root.parent / "dso"))
    return next((path for path in found if path is not None), None)


def _read_euroc_truth(
    root: Path, left: Path, stamps_s: Float64
) -> tuple[SequenceTruth | None, str]:
    path = next((p for name in _TRUTHS if (p := root / name / "data.csv").is_file()), None)
    if path is None:
        return None, ""
    sensor, chain = left / "sensor.yaml", _chain(root)
    if sensor.is_file():
        T_body_camera = read_euroc_camera(sensor)[1]
    else:  # in TUM VI the body is the inertial unit (Schubert et al., IROS 2018)
        T_camera_imu = None if chain is None else read_kalibr_imu(chain)
        if T_camera_imu is None:
            return None, ""
        T_body_camera = invert(T_camera_imu)
    return truth_at(read_euroc_truth(path), stamps_s, T_body_camera)


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
