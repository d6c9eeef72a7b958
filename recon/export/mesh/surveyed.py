"""A mesh in the coordinates of a survey, from an offset that stands beside it.

Mesh files have single precision, which at an easting of 456 km is 3 cm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply, rotate
from recon.core.values import TriangleMesh
from recon.export.product import ExportContext
from recon.io.atomic import write_text
from recon.io.models.las import check_crs
from recon.io.models.mesh import write_mesh

_ROUND_M: Final = 100.0


def write_surveyed(
    context: ExportContext, mesh: TriangleMesh, folder: Path, formats: Sequence[str]
) -> Sequence[float] | None:
    """Write a mesh, map axes, once more into a folder; return what is to be added, metres.

    Its axes are east, north and up. ``offset.xyz`` has what is to be added to its coordinates:
    hundreds of metres to the east and north; ``mesh.prj`` the coordinate system, if it is known.
    Without a survey nothing is written.
    """
    if context.survey is None:
        return None
    T_survey_map = context.T_survey_map
    offset_m = np.array([*(np.floor(T_survey_map[:2, 3] / _ROUND_M) * _ROUND_M), 0.0])
    T_mesh_map = T_survey_map.copy()
    T_mesh_map[:3, 3] -= offset_m
    normals = None if mesh.normals is None else rotate(T_mesh_map, mesh.normals.astype(np.float64))
    moved = replace(
        mesh,
        vertices=apply(T_mesh_map, mesh.vertices.astype(np.float64)).astype(np.float32),
        normals=None if normals is None else normals.astype(np.float32),
    )
    for suffix in dict.fromkeys(formats):
        write_mesh(folder / f"mesh.{suffix}", moved, "map")
    text = " ".join(f"{metres:.0f}" for metres in offset_m)
    write_text(folder / "offset.xyz", f"{text}\n")
    if context.crs is not None:
        wkt = check_crs(context.crs).to_wkt("WKT1_ESRI")
        write_text(folder / "mesh.prj", f"{wkt}\n")
    return list(offset_m.tolist())
