"""MeshLab projects (.mlp): several layers opened together."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from recon.core.errors import OutputError
from recon.core.geometry.se3 import T_YUP_FRAME, make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.core.values.cloud import Frame
from recon.io.atomic import write_text
from recon.io.files import StrPath, resolved

_IDENTITY: Final = np.eye(4)
_SENSOR_MM: Final = 36.0  # width of the sensor of MeshLab's cameras; only ratios to it matter


@dataclass(frozen=True)
class Photo:
    """The image of a camera."""

    file: Path
    camera: RectifiedCamera
    # float64 (4, 4), its pose in the frame of the layers; else it is at their origin
    T_frame_camera: Float64 = field(default_factory=lambda: np.eye(4))


def write_mlp(
    path: StrPath,
    layers: Mapping[str, StrPath],
    frame: Frame | None = None,
    photos: Sequence[Photo] = (),
) -> None:
    """Write a MeshLab project of layers (label and existing file), atomically.

    Paths are relative to it. MeshLab opens it with y up and looks along -z: layers are turned if
    their frame is known.
    """
    T = _IDENTITY if frame is None else T_YUP_FRAME[frame]
    project = ET.Element("MeshLabProject")
    group = ET.SubElement(project, "MeshGroup")
    for label, file in layers.items():
        layer = {"label": label, "filename": _relative(file, Path(path)), "visible": "1"}
        ET.SubElement(ET.SubElement(group, "MLMesh", layer), "MLMatrix44").text = _rows(T)
    rasters = ET.SubElement(project, "RasterGroup")
    for photo in photos:
        _add_photo(rasters, photo, T, Path(path))
    ET.indent(project, " ")
    body = ET.tostring(project, encoding="unicode")
    write_text(path, f"<!DOCTYPE MeshLabDocument>\n{body}\n")


def _add_photo(group: ET.Element, photo: Photo, T: Float64, project: Path) -> None:
    """Add a raster layer: an image, and where MeshLab's camera has to stand to see it."""
    camera = photo.camera
    pixel_mm = _SENSOR_MM / camera.width_px
    raster = ET.SubElement(group, "MLRaster", {"label": photo.file.stem})
    # MeshLab counts from the lower left corner of the image, and cameras look along -z. It takes
    # the position of the camera with the other sign.
    T_world_camera = T @ photo.T_frame_camera @ T_YUP_FRAME["camera"].T
    R_camera_world = make_transform(T_world_camera[:3, :3].T, np.zeros(3))
    lens = {
        "TranslationVector": " ".join(f"{x:.10g}" for x in (*(0 - T_world_camera[:3, 3]), 1)),
        "RotationMatrix": " ".join(_rows(R_camera_world).split()),
        "FocalMm": f"{camera.focal_px * pixel_mm:.10g}",
        "PixelSizeMm": f"{pixel_mm:.10g} {pixel_mm:.10g}",
        "ViewportPx": f"{camera.width_px} {camera.height_px}",
        "CenterPx": f"{camera.cx_px + 0.5:.10g} {camera.height_px - 0.5 - camera.cy_px:.10g}",
    }
    plain = {"LensDistortion": "0 0", "CameraType": "0", "BinaryData": "0"}
    ET.SubElement(raster, "VCGCamera", lens | plain)
    ET.SubElement(raster, "Plane", {"semantic": "1", "fileName": _relative(photo.file, project)})


def _rows(T: Float64) -> str:
    return "\n" + "".join(" ".join(f"{x:.10g}" for x in row) + " \n" for row in T)


def _relative(file: StrPath, project: Path) -> str:
    if not Path(file).is_file():
        raise OutputError(
            "a layer of the MeshLab project does not exist", where=file, hint="write it first"
        )
    return Path(os.path.relpath(resolved(file), resolved(project).parent)).as_posix()
