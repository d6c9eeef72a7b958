"""Open3D's mesh files and mesh processing: arrays in, arrays out, its errors converted to ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, MeshingError, OutputError
from recon.core.lazy import Lazy
from recon.core.text import counted
from recon.core.values import TriangleMesh
from recon.core.values.arrays import Float32, Int32
from recon.io.files import StrPath

o3d = Lazy("open3d")


def write_mesh(path: StrPath, mesh: TriangleMesh) -> None:
    """Write OBJ or STL, chosen by the suffix."""
    surface = to_open3d(mesh)
    with _quiet():
        surface.compute_triangle_normals()
        written = o3d.io.write_triangle_mesh(Path(path), surface)
    if not written:
        raise OutputError("Open3D could not write the mesh", where=path)


def to_open3d(shape: Any) -> Any:
    """Return a mesh or a cloud as Open3D's, with its normals and colours."""
    is_mesh, geometry = isinstance(shape, TriangleMesh), o3d.geometry
    made = (
        _surface(shape.vertices, shape.faces)
        if is_mesh
        else geometry.PointCloud(_vectors(shape.xyz))
    )
    of = "vertex_" if is_mesh else ""
    if shape.normals is not None:
        setattr(made, f"{of}normals", _vectors(shape.normals))
    if shape.rgb is not None:
        setattr(made, f"{of}colors", _vectors(shape.rgb / 255))
    return made


def read_mesh(path: StrPath) -> TriangleMesh:
    """Read OBJ, STL, GLB or another format that Open3D knows, chosen by the suffix."""
    with _quiet():
        mesh = o3d.io.read_triangle_mesh(Path(path))
    if not mesh.has_triangles():
        raise FormatError("the file has no triangles that Open3D can read", where=path)
    normals = np.asarray(mesh.vertex_normals).astype(np.float32)
    rgb = np.rint(np.asarray(mesh.vertex_colors) * 255).astype(np.uint8)
    return TriangleMesh(
        vertices=np.asarray(mesh.vertices).astype(np.float32),
        faces=np.asarray(mesh.triangles).astype(np.int32),
        normals=normals if mesh.has_vertex_normals() else None,
        rgb=rgb if mesh.has_vertex_colors() else None,
    )


def decimate(
    vertices: NDArray[Any], faces: NDArray[Any], target_faces: int
) -> tuple[Float32, Int32]:
    """Collapse edges until about ``target_faces`` are left (Garland & Heckbert, 1997)."""
    with _quiet():
        smaller = _surface(vertices, faces).simplify_quadric_decimation(
            target_faces, boundary_weight=3.0
        )
    if not smaller.has_triangles():
        got = f"target of {counted(target_faces, 'face')}"
        raise MeshingError("decimation left no face", got=got)
    vertices, faces = np.asarray(smaller.vertices), np.asarray(smaller.triangles)
    return vertices.astype(np.float32), faces.astype(np.int32)


def _surface(vertices: NDArray[Any], faces: NDArray[Any]) -> Any:
    """Return an Open3D mesh of copies; it accepts neither read-only nor float32 arrays."""
    return o3d.geometry.TriangleMesh(
        _vectors(vertices),
        o3d.utility.Vector3iVector(np.array(faces, dtype=np.int32)),
    )


def _vectors(values: NDArray[Any]) -> Any:
    return o3d.utility.Vector3dVector(np.array(values, dtype=np.float64))


def _quiet() -> Any:
    """Keep Open3D's warnings off standard output; errors that matter are checked and raised."""
    return o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
