"""MeshLab projects (.mlp): several layers opened together."""

from __future__ import annotations

import os
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree as ET

from recon.errors import OutputError
from recon.formats.atomic import write_text

_IDENTITY = "\n1 0 0 0 \n0 1 0 0 \n0 0 1 0 \n0 0 0 1 \n"


def write_mlp(path: str | PathLike[str], layers: Mapping[str, str | PathLike[str]]) -> None:
    """Write a MeshLab project.

    File paths are relative to the project, so the folder can be moved as a whole.

    Args:
        path: The project file, written atomically.
        layers: Label and file of each layer, such as ``{"cloud": "map/cloud.ply"}``; the files
            must exist.

    Raises:
        OutputError: A layer's file does not exist, or the project cannot be written.
    """
    project = ET.Element("MeshLabProject")
    group = ET.SubElement(project, "MeshGroup")
    for label, file in layers.items():
        layer = {"label": label, "filename": _relative(file, Path(path)), "visible": "1"}
        ET.SubElement(ET.SubElement(group, "MLMesh", layer), "MLMatrix44").text = _IDENTITY
    ET.SubElement(project, "RasterGroup")
    ET.indent(project, " ")
    body = ET.tostring(project, encoding="unicode")
    write_text(path, f"<!DOCTYPE MeshLabDocument>\n{body}\n")


def _relative(file: str | PathLike[str], project: Path) -> str:
    """Path of a layer's file relative to the project's folder."""
    if not Path(file).is_file():
        raise OutputError(
            "a layer of the MeshLab project does not exist", where=file, hint="write it first"
        )
    return Path(os.path.relpath(Path(file).resolve(), project.resolve().parent)).as_posix()
