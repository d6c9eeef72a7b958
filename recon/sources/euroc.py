"""Drives in the layout of EuRoC (ASL), also used by TUM VI and others.

::

    folder/
      mav0/                            (or its content directly)
        cam0/ cam1/
          data.csv                     time [ns], file name
          data/1403636579763555584.png
          sensor.yaml                  lens, size, T_BS (or a camchain for both cameras)
        state_groundtruth_estimate0/   optional: ground truth trajectory of the body
          data.csv
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.geometry.se3 import invert
from recon.core.values import Rig, SequenceTruth, StereoCalibration, check_size
from recon.core.values.arrays import Float64
from recon.io.cameras.euroc import NS, read_euroc_camera, read_euroc_truth
from recon.io.files import resolved
from recon.sources.calibration import as_rectified, find_calibration, read_rig
from recon.sources.images import ImageSource, image_size, pair_listed
from recon.sources.settings import SourceSettings
from recon.sources.stamps import check_increasing
from recon.sources.times import read_stamped_names, truth_at

_TRUTH: Final = "state_groundtruth_estimate0"


def open_euroc(folder: Path, settings: SourceSettings) -> ImageSource:
    """Open a drive; its images are paired by timestamp.

    The ground truth is interpolated to the timestamps; it is used only if it covers every frame.
    """
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    views = [root / (settings.left or "cam0"), root / (settings.right or "cam1")]
    lists = [_read_list(view) for view in views]
    frames, listing = pair_listed(lists, settings, root)
    rig, calibration_files = _read_rig(root, settings, views, image_size(frames[0].left, settings))
    truth, note = _read_truth(root, views[0], np.array([frame.timestamp_s for frame in frames]))
    return ImageSource(
        name=resolved(folder).name,
        description=f"EuRoC drive, {views[0].name} and {views[1].name}, paired by stamps{listing}"
        f"{note}",
        calibration=rig,
        images=frames,
        listing=listing,
        truth=truth,
        texts=(*calibration_files, *(view / "data.csv" for view in views)),
    )


def _read_list(view: Path) -> list[tuple[float, Path]]:
    if not view.is_dir():
        raise SourceError("folder of a camera is missing", where=view)
    path = view / "data.csv"
    entries = read_stamped_names(path, unit_s=NS)
    check_increasing(np.array([stamp for stamp, _ in entries]), str(path))
    return [(stamp, view / "data" / name) for stamp, name in entries]


def _read_rig(
    root: Path, settings: SourceSettings, views: list[Path], size: tuple[int, int]
) -> tuple[Rig, tuple[Path, ...]]:
    if settings.has_camera:
        return read_rig(settings, root, size)
    paths = [view / "sensor.yaml" for view in views]
    if not paths[0].is_file():
        # TUM VI has one file for both cameras instead, beside mav0 or in another folder there.
        return read_rig(settings, _with_calibration(root), size)
    (left, T_body_left), (right, T_body_right) = (read_euroc_camera(path) for path in paths)
    rig = StereoCalibration(left, right, invert(T_body_right) @ T_body_left)
    check_size(rig, *size, paths[0])
    return as_rectified(rig), tuple(paths)


def _with_calibration(root: Path) -> Path:
    places = (root, root.parent, root.parent / "dso")
    return next((place for place in places if find_calibration(place)), root)


def _read_truth(root: Path, left: Path, stamps_s: Float64) -> tuple[SequenceTruth | None, str]:
    """Return the truth at the times of the frames, and a note if it does not cover them all."""
    path, sensor = root / _TRUTH / "data.csv", left / "sensor.yaml"
    if not (path.is_file() and sensor.is_file()):
        return None, ""
    _, T_body_camera = read_euroc_camera(sensor)
    return truth_at(read_euroc_truth(path), stamps_s, T_body_camera)
