"""Trimming of meshes: vertices, small components, normals."""

from __future__ import annotations

import numpy as np

from recon.core.errors import MeshingError
from recon.core.values.arrays import Bool, Float32, Int32
from recon.io.models import open3d_meshes


def keep_vertices(vertices: Float32, faces: Int32, keep: Bool) -> tuple[Float32, Int32]:
    """Return the part of a mesh whose faces have all three vertices in ``keep``.

    Args:
        vertices: float32 (V, 3).
        faces: int32 (F, 3).
        keep: bool (V,).

    Returns:
        The remaining vertices that a face uses, and the faces, renumbered.
    """
    return _compact(vertices, faces[keep[faces].all(axis=1)])


def drop_small_components(vertices: Float32, faces: Int32, min_faces: int) -> tuple[Float32, Int32]:
    """Return the connected pieces of a mesh that have at least ``min_faces`` faces."""
    labels, sizes = open3d_meshes.component_labels(vertices, faces)
    return _compact(vertices, faces[sizes[labels] >= min_faces])


def vertex_normals(vertices: Float32, faces: Int32) -> Float32:
    """Return float32 (V, 3): unit normals, the area-weighted mean of those of their faces."""
    corners = vertices[faces].astype(np.float64)
    # The length of the cross product is twice the area, so the mean is weighted by area.
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = faces.ravel()
    sums = [np.bincount(flat, np.repeat(axis, 3), len(vertices)) for axis in of_faces.T]
    normals = np.stack(sums, axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(length, 1e-30), dtype=np.float32)


def _compact(vertices: Float32, faces: Int32) -> tuple[Float32, Int32]:
    """Drop the vertices that no face uses and renumber the rest."""
    if len(faces) == 0:
        raise MeshingError(
            "trimming left no face of the surface",
            hint="raise mesh.max_depth or mesh.max_distance_spacings, or filter less",
        )
    used, faces = renumbered(faces)
    return vertices[used], faces


def renumbered(faces: Int32) -> tuple[Int32, Int32]:
    """Return int32 (V,): vertices that faces (F, 3) use, ascending; and the faces with these."""
    used = np.flatnonzero(np.bincount(faces.ravel())).astype(np.int32)
    numbers = np.zeros(used.max(initial=-1) + 1, np.int32)
    numbers[used] = np.arange(len(used))
    return used, numbers[faces]
