"""Drives with a list of images and times for each camera: of TUM and of EuRoC (ASL, TUM VI).

::

    folder/                            TUM
      left.txt right.txt               time [s] and file per line (or cam0.txt cam1.txt …)
      left/1305031102.175304.png …
      groundtruth.txt                  optional: t tx ty tz qx qy qz qw of the left camera
      calib.txt                        or any other supported calibration file

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
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.geometry.se3 import invert
from recon.core.values import ImuRecord, Rig, SequenceTruth, StereoCalibration, check_size
from recon.core.values.arrays import Float64
from recon.io.cameras.ros import NS, read_euroc_camera, read_euroc_truth
from recon.io.files import resolved
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
