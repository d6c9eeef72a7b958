"""The surface of a pair as a closed body, such as printers need."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.errors import MeshingError
from recon.core.values import TriangleMesh
from recon.core.values.arrays import Float32, Int32
from recon.export.mesh.cut import vertex_normals

_LEAST_THICKNESS: Final = 1e-5  # of the depth; coordinates are exact to less than a hundredth of it
_APART: Final = 0.05  # of the way to the middle of its triangles, that a corner moves off another


def closed_behind(mesh: TriangleMesh, thickness_m: float) -> TriangleMesh:
    """Close the surface that a camera sees, at a thickness behind it.

    Each vertex is repeated on its ray, farther by the thickness in depth; walls along all edges of
    the surface, those of holes too, join both. No two rays meet, so that no part of the body is in
    another, nor are bodies of surfaces that lie one behind the other.

    Args:
        mesh: A manifold mesh in camera axes, of which a ray meets one triangle at most. Surfaces
            that touch in a vertex have one each, which are moved apart by a part of a pixel.
        thickness_m: Above 0.

    Returns:
        A watertight mesh, with unit normals outwards; the vertices behind have the colours of those
        before them.

    Raises:
        MeshingError: The thickness is lost in the precision of the coordinates.
    """
    least_m = _LEAST_THICKNESS * float(mesh.vertices[:, 2].max())
    if thickness_m < least_m:
        what, expected = "the solid is too thin for its distance", f"at least {least_m:.3g} m"
        hint = "raise mesh.pair_solid_m"
        raise MeshingError(what, got=f"{thickness_m:g} m", expected=expected, hint=hint)
    front = _moved_apart(mesh.vertices, mesh.faces)
    back = front * (1 + thickness_m / front[:, 2:].astype(np.float64))
    vertices = np.concatenate([front, back]).astype(np.float32)
    behind, edges = mesh.faces + len(front), _border(mesh.faces)
    (a, b), (c, d) = edges.T, edges.T + len(front)
    walls = np.concatenate([np.stack([b, a, c], axis=1), np.stack([b, c, d], axis=1)])
    faces = np.concatenate([mesh.faces, behind[:, ::-1], walls]).astype(np.int32)
    rgb = None if mesh.rgb is None else np.concatenate([mesh.rgb, mesh.rgb])
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)


def _border(faces: Int32) -> Int32:
    """Return the edges (E, 2) that one triangle alone has, in its direction."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    ends = np.sort(edges, axis=1)
    _, first, count = np.unique(ends, axis=0, return_index=True, return_counts=True)
    return np.asarray(edges[first[count == 1]])


def _moved_apart(vertices: Float32, faces: Int32) -> Float32:
    """Return vertices (V, 3), of which no two are in one place: else programs join them again."""
    _, place, count = np.unique(vertices, axis=0, return_inverse=True, return_counts=True)
    shared = count[place.ravel()] > 1
    middles = vertices[faces].mean(axis=1, dtype=np.float64)
    corner, face = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    number = np.maximum(np.bincount(corner, minlength=len(vertices)), 1)
    inside = [np.bincount(corner, axis[face], len(vertices)) / number for axis in middles.T]
    moved = vertices + _APART * (np.stack(inside, axis=1) - vertices)
    return np.where(shared[:, None], moved, vertices).astype(np.float32)
