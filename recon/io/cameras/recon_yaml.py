"""Our own calibration format: YAML with the unit in every name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, cast

import numpy as np
import yaml

from recon.core.errors import FormatError
from recon.core.geometry.se3 import make_transform
from recon.core.values import CameraIntrinsics, LensModel, RectifiedCamera, Rig, StereoCalibration
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.io.cameras.ros import pinhole_matrix
from recon.io.fields import Fields, read_yaml
from recon.io.files import StrPath, reader

MARK: Final = "recon-calibration"
_VERSION: Final = 1
_HEADER: Final = """\
# Pixel centres are at integers; camera axes: x right, y down, z forward.
# xyz_right = rotation * xyz_left + translation_m
"""
_NAMES: Final[dict[str, tuple[str, ...]]] = {  # of coefficients, by lens model
    "pinhole": (
        "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty",
    ),
    "fisheye": ("k1", "k2", "k3", "k4"),
}  # fmt: skip
_RECTIFIED: Final = ("focal_px", "cx_px", "cy_px", "cx_right_px", "baseline_m")


def write_recon_calibration(
    path: StrPath, calibration: Rig, quality: Mapping[str, Any] | None = None
) -> None:
    """Write a calibration atomically; figures of its ``quality`` are not read back."""
    content = {"format": MARK, "version": _VERSION, **_content(calibration)}
    if quality:
        content["quality"] = dict(quality)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    write_text(path, _HEADER + text)


@reader
def read_recon_calibration(path: StrPath) -> Rig:
    """Read what `write_recon_calibration` wrote."""
    fields = Fields(read_yaml(path))
    if fields.text("format") != MARK or fields.number("version") != _VERSION:
        got, expected = f"{fields.get('format')} {fields.get('version')}", f"{MARK} {_VERSION}"
        what = "version of the calibration file is not supported"
        raise FormatError(what, got=got, expected=expected)
    kind = fields.text("kind")
    if kind == "rectified":
        camera = fields.below("camera")
        return RectifiedCamera(
            **{name: camera.number(name) for name in _RECTIFIED},
            width_px=camera.count("width_px"),
            height_px=camera.count("height_px"),
            ndisp=camera.count("ndisp") if "ndisp" in camera else None,
        )
    if kind != "stereo":
        raise FormatError("unknown kind of calibration", got=kind, expected="stereo or rectified")
    pose = fields.below("right_from_left")
    T = make_transform(pose.numbers("rotation", (3, 3)), pose.numbers("translation_m", (3,)))
    left, right = (_read_camera(fields.below(side)) for side in ("left", "right"))
    return StereoCalibration(left, right, T)


def _content(calibration: Rig) -> dict[str, Any]:
    if isinstance(calibration, RectifiedCamera):
        numbers = {name: float(getattr(calibration, name)) for name in _RECTIFIED}
        size = {"width_px": calibration.width_px, "height_px": calibration.height_px}
        searched = {} if calibration.ndisp is None else {"ndisp": calibration.ndisp}
        return {"kind": "rectified", "camera": {**size, **numbers, **searched}}
    T = calibration.T_right_left
    return {
        "kind": "stereo",
        "left": _camera_content(calibration.left),
        "right": _camera_content(calibration.right),
        "right_from_left": {"rotation": T[:3, :3].tolist(), "translation_m": T[:3, 3].tolist()},
    }


def _camera_content(camera: CameraIntrinsics) -> dict[str, Any]:
    K = camera.matrix
    pinhole = {"fx_px": K[0, 0], "fy_px": K[1, 1], "cx_px": K[0, 2], "cy_px": K[1, 2]}
    return {
        "model": camera.model,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        **{name: float(value) for name, value in pinhole.items()},
        "distortion": dict(zip(_NAMES[camera.model], camera.distortion.tolist(), strict=False)),
    }


def _read_camera(fields: Fields) -> CameraIntrinsics:
    model = cast("LensModel", fields.text("model"))
    if model not in _NAMES:
        raise FormatError("unknown lens model", got=model, expected="pinhole or fisheye")
    fx, fy, cx, cy = (fields.number(name) for name in ("fx_px", "fy_px", "cx_px", "cy_px"))
    distortion = _read_distortion(fields.below("distortion"), _NAMES[model])
    size = fields.count("width_px"), fields.count("height_px")
    return CameraIntrinsics(pinhole_matrix(fx, fy, cx, cy), distortion, *size, model)


def _read_distortion(fields: Fields, names: tuple[str, ...]) -> Float64:
    known = [name for name in names if name in fields]
    if known != list(names[: len(known)]):
        raise FormatError("distortion has gaps", got=", ".join(known), expected=", ".join(names))
    return np.array([fields.number(name) for name in known], dtype=np.float64)
