"""A rig written to files, in the format that their name asks for."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from recon.core.errors import SettingsError
from recon.core.values import CameraIntrinsics, Rig
from recon.io.cameras.calibration import write_opencv_calibration, write_recon_calibration
from recon.io.cameras.ros import camera_info_paths, write_camera_info, write_kalibr
from recon.look.fault import spread_pixels
from recon.stereo.rectify.epipolar import as_raw
from recon.stereo.rectify.lens import project_with_jacobian, rays_of
from recon.stereo.rectify.rectifier import RectificationSettings, turns_of

CalibrationForm = Literal["recon", "opencv", "ros", "kalibr"]
_NAMES: Final[dict[CalibrationForm, re.Pattern[str]]] = {  # the first that fits
    "kalibr": re.compile(r".*(cam_?chain|kalibr).*\.ya?ml"),
    "ros": re.compile(r"(.*[_.-])?(camera_?info|left|right)([_.-].*)?\.ya?ml"),
    "opencv": re.compile(r".*opencv.*\.yaml|.*\.(yml|xml|json)"),
    "recon": re.compile(r".*\.yaml"),
}
NAMES_OF_FORMS: Final = (
    "NAME.yaml is ours, NAME.yml, .xml or .json OpenCV's, camchain.yaml kalibr's, "
    "camera_info.yaml or left.yaml the two files of ROS (_left and _right)"
)
_KALIBR_TERMS: Final = 4  # of a lens: k1 k2 p1 p2
_GRID: Final = (24, 16)  # pixels across and down by which lenses are compared
_ROUNDS: Final = 10  # of Gauss-Newton, of which the first few do nearly all


def form_of(path: Path) -> CalibrationForm:
    """Return the format that the name of a calibration file asks for."""
    for form, name in _NAMES.items():
        if name.fullmatch(path.name.lower()):
            return form
    what = "the name of a calibration file tells its format, and this one does not"
    raise SettingsError(what, where=path, expected=NAMES_OF_FORMS)


def targets_of(path: Path, form: CalibrationForm | None = None) -> tuple[Path, ...]:
    """Return the files that a rig is written to; ``form`` None = by the name."""
    return camera_info_paths(path) if (form or form_of(path)) == "ros" else (path,)


def write_rig(
    path: Path,
    rig: Rig,
    settings: RectificationSettings,
    form: CalibrationForm | None = None,
    quality: Mapping[str, Any] | None = None,
) -> tuple[Path, ...]:
    """Write a rig, each file atomically, and return the files: two of ROS, else one.

    ``settings`` are those of the rectification that a CameraInfo states; only our own files keep
    the ``quality``; a form of None is that of the name.
    """
    form = form or form_of(path)
    if form == "recon":
        write_recon_calibration(path, rig, quality)
    elif form == "opencv":
        write_opencv_calibration(path, as_raw(rig))
    elif form == "kalibr":
        write_kalibr(path, as_raw(rig))
    else:
        turns = turns_of(rig, settings)
        write_camera_info(path, as_raw(rig), (turns.R_left, turns.R_right), turns.camera)
    return targets_of(path, form)


def nearest_of_kalibr(rig: Rig) -> tuple[Rig, float]:
    """Return a rig with the nearest lenses that kalibr knows, and how far they are, rms pixels."""
    raw = as_raw(rig)
    (left, left_px), (right, right_px) = map(_of_four_terms, (raw.left, raw.right))
    return replace(raw, left=left, right=right), max(left_px, right_px)


def _of_four_terms(camera: CameraIntrinsics) -> tuple[CameraIntrinsics, float]:
    """Return the nearest camera with k1 k2 p1 p2 alone, and how far it is, rms pixels."""
    if camera.model != "pinhole" or not camera.distortion[_KALIBR_TERMS:].any():
        return camera, 0.0
    pixels = spread_pixels(camera, _GRID).reshape(-1, 2)
    rays = rays_of(camera, pixels)
    known = np.isfinite(rays).all(axis=1)
    near = replace(camera, distortion=camera.distortion[:_KALIBR_TERMS])
    for _ in range(_ROUNDS):
        seen, _, by_lens = project_with_jacobian(near, rays[known])
        off = pixels[known] - seen
        step = np.linalg.lstsq(by_lens.reshape(off.size, -1), off.ravel(), rcond=None)[0]
        matrix = near.matrix.copy()
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
        near = replace(near, matrix=matrix, distortion=near.distortion + step[4:])
    return near, float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
