"""MeshLab projects (.mlp): several layers opened together."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from recon.core.errors import OutputError
from recon.core.geometry.se3 import T_YUP_FRAME
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.core.values.cloud import Frame
from recon.io.atomic import write_text
from recon.io.files import StrPath, resolved

_IDENTITY: Final = np.eye(4)
_SENSOR_MM: Final = 36.0  # width of the sensor of MeshLab's cameras; only ratios to it matter


@dataclass(frozen=True)
class Photo:
    """The image of a camera at the origin of the layers, looking along their z axis."""

    file: Path
    camera: RectifiedCamera


def write_mlp(
    path: StrPath,
    layers: Mapping[str, StrPath],
    frame: Frame | None = None,
    photo: Photo | None = None,
) -> None:
    """Write a MeshLab project of layers (label and file, which must exist), atomically.

    Paths are relative to it. MeshLab opens it with y up and looks along -z, so layers are turned if
    their frame is known. The camera of a photo is at the origin of the frame ``camera``.
    """
    T = _IDENTITY if frame is None else T_YUP_FRAME[frame]
    project = ET.Element("MeshLabProject")
    group = ET.SubElement(project, "MeshGroup")
    for label, file in layers.items():
        layer = {"label": label, "filename": _relative(file, Path(path)), "visible": "1"}
        ET.SubElement(ET.SubElement(group, "MLMesh", layer), "MLMatrix44").text = _rows(T)
    rasters = ET.SubElement(project, "RasterGroup")
    if photo is not None:
        _add_photo(rasters, photo, Path(path))
    ET.indent(project, " ")
    body = ET.tostring(project, encoding="unicode")
    write_text(path, f"<!DOCTYPE MeshLabDocument>\n{body}\n")


def _add_photo(group: ET.Element, photo: Photo, project: Path) -> None:
    """Add a raster layer: an image, and where MeshLab's camera has to stand to see it."""
    camera = photo.camera
    pixel_mm = _SENSOR_MM / camera.width_px
    raster = ET.SubElement(group, "MLRaster", {"label": photo.file.stem})
    # MeshLab counts from the lower left corner of the image, and cameras look along -z.
    lens = {
        "TranslationVector": "0 0 0 1",
        "RotationMatrix": " ".join(_rows(_IDENTITY).split()),
        "FocalMm": f"{camera.focal_px * pixel_mm:.10g}",
        "PixelSizeMm": f"{pixel_mm:.10g} {pixel_mm:.10g}",
        "ViewportPx": f"{camera.width_px} {camera.height_px}",
        "CenterPx": f"{camera.cx_px + 0.5:.10g} {camera.height_px - 0.5 - camera.cy_px:.10g}",
    }
    plain = {"LensDistortion": "0 0", "CameraType": "0", "BinaryData": "0"}
    ET.SubElement(raster, "VCGCamera", lens | plain)
    ET.SubElement(raster, "Plane", {"semantic": "1", "fileName": _relative(photo.file, project)})


def _rows(T: Float64) -> str:
    return "\n" + "".join(" ".join(f"{x:g}" for x in row) + " \n" for row in T)


def _relative(file: StrPath, project: Path) -> str:
    if not Path(file).is_file():
        raise OutputError(
            "a layer of the MeshLab project does not exist", where=file, hint="write it first"
        )
    return Path(os.path.relpath(resolved(file), resolved(project).parent)).as_posix()
