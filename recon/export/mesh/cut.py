"""Cutting meshes along planes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values import TriangleMesh
from recon.core.values.arrays import Bool, Float32, Float64, Int32
from recon.export.mesh.surgery import renumbered


@dataclass(frozen=True)
class Plane:
    """A plane perpendicular to an axis.

    Attributes:
        axis: 0 = x, 1 = y, 2 = z.
        at_m: Coordinate on that axis.
    """

    axis: int
    at_m: float

    def holds(self, vertices: Float32) -> Bool:
        """Return bool (V,): vertices that lie exactly in the plane, as those of a cut do."""
        return np.asarray(vertices[:, self.axis] == np.float32(self.at_m))


def cut_mesh(mesh: TriangleMesh, plane: Plane, *, keep_above: bool) -> TriangleMesh:
    """Return the part of a mesh on one side of a plane; triangles that cross it are split.

    Two meshes of one surface, cut along the same plane, meet there without overlap.

    Args:
        mesh: Any mesh.
        plane: Where to cut.
        keep_above: Keep the side of larger coordinates, else that of smaller ones.

    Returns:
        The part; it may be empty. New vertices lie exactly in the plane; their normals and
        colours are interpolated along the cut edges.
    """
    away = mesh.vertices[:, plane.axis] - np.float32(plane.at_m)
    away = away if keep_above else -away
    inside = away >= 0
    count = inside[mesh.faces].sum(axis=1)
    whole = mesh.faces[count == 3]
    one, two = (_first_turned(mesh.faces[count == n], inside, n) for n in (1, 2))
    # The two cut edges meet at the only corner inside, or at the only one outside.
    cut = np.concatenate([one[:, [0, 1]], one[:, [0, 2]], two[:, [1, 2]], two[:, [0, 2]]])
    edges, where = np.unique(np.sort(cut, axis=1), axis=0, return_inverse=True)
    new = (len(mesh.vertices) + where.ravel()).astype(np.int32)
    a, b, c, d = np.split(new, np.cumsum([len(one), len(one), len(two)]))
    faces = np.concatenate(
        [
            whole,
            np.stack([one[:, 0], a, b], axis=1),
            np.stack([two[:, 0], two[:, 1], c], axis=1),
            np.stack([two[:, 0], c, d], axis=1),
        ]
    )
    return _compact(_with_cuts(mesh, edges, away, plane), faces.astype(np.int32))


def with_vertices(mesh: TriangleMesh, new: Float32, edges: Int32, share: Float64) -> TriangleMesh:
    """Add vertices on edges of a mesh; no face uses them yet.

    Args:
        mesh: Any mesh.
        new: float32 (N, 3), the vertices.
        edges: int32 (N, 2), the edge of each vertex; normals and colours are interpolated on it.
        share: float64 (N,), position along the edge, from 0 to 1.
    """
    normals, rgb = mesh.normals, mesh.rgb
    if normals is not None:
        mixed = between(normals, edges, share)
        mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12)
        normals = np.concatenate([normals, mixed.astype(np.float32)])
    if rgb is not None:
        mixed = np.rint(between(rgb, edges, share))
        rgb = np.concatenate([rgb, mixed.astype(np.uint8)])
    return TriangleMesh(np.concatenate([mesh.vertices, new]), mesh.faces, normals, rgb)


def between(values: NDArray[Any], edges: Int32, share: Float64) -> Float64:
    """Return float64 (N, 3): vertex values (V, 3), interpolated linearly along edges."""
    first, last = values[edges[:, 0]], values[edges[:, 1]]
    return np.asarray((1 - share[:, None]) * first + share[:, None] * last)


def _first_turned(faces: Int32, inside: Bool, corners: int) -> Int32:
    """Return faces (F, 3), each rotated so that its ``corners`` corners inside come first."""
    odd = inside[faces] if corners == 1 else ~inside[faces]
    # The odd corner comes first if it is inside, last if it is outside.
    start = (np.argmax(odd, axis=1) + (0 if corners == 1 else 1)) % 3
    order = (start[:, None] + np.arange(3)) % 3
    return np.asarray(np.take_along_axis(faces, order, axis=1), dtype=np.int32)


def _with_cuts(mesh: TriangleMesh, edges: Int32, away: Float32, plane: Plane) -> TriangleMesh:
    """Return the mesh with a new vertex where each edge (E, 2) meets the plane."""
    first, last = edges.T
    share = (away[first] / (away[first] - away[last])).astype(np.float64)
    new = between(mesh.vertices, edges, share).astype(np.float32)
    new[:, plane.axis] = np.float32(plane.at_m)
    return with_vertices(mesh, new, edges, share)


def _compact(mesh: TriangleMesh, faces: Int32) -> TriangleMesh:
    """Return the faces with the vertices that they use; degenerate faces of a cut are dropped."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, faces = renumbered(faces)
    return TriangleMesh(
        mesh.vertices[used],
        faces,
        None if mesh.normals is None else mesh.normals[used],
        None if mesh.rgb is None else mesh.rgb[used],
    )
