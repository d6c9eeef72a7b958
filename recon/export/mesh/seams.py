"""Closing of seams between meshes that are cut along the same plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.values import TriangleMesh
from recon.core.values.arrays import Float32, Float64, Int32
from recon.export.mesh.cut import Plane, with_vertices
from recon.stereo.cloud import open3d_clouds

_CANDIDATES: Final = 8
_SAME_M: Final = 1e-5


@dataclass(frozen=True, eq=False)
class OnEdges:
    """Projections of points onto line segments.

    Attributes:
        edge: int64 (N,), index of the segment.
        share: float64 (N,), position along it, from 0 to 1.
        feet: float64 (N, 3), the projected points.
        distance_m: float64 (N,), distance of each point to its projection.
    """

    edge: np.ndarray[tuple[int], np.dtype[np.int64]]
    share: Float64
    feet: Float64
    distance_m: Float64


def open_edges(mesh: TriangleMesh, plane: Plane) -> Float32:
    """Return boundary edges of a mesh that lie in a plane: float32 (E, 2, 3)."""
    return np.asarray(mesh.vertices[_open_corners(mesh, plane)[:, :2]])


def close_seam(mesh: TriangleMesh, plane: Plane, border: Float32, reach_m: float) -> TriangleMesh:
    """Fit a mesh to the border of its neighbour, cut along the same plane.

    The vertices of the mesh move onto the border, and those of the border are inserted into the
    mesh, so that both follow the same line.

    Args:
        mesh: The mesh.
        plane: The plane of the cut.
        border: float32 (E, 2, 3), the neighbour's `open_edges`.
        reach_m: Vertices farther from the other mesh stay, since it has no surface there.
    """
    rows = np.flatnonzero(plane.holds(mesh.vertices))
    if not len(rows) or not len(border):
        return mesh
    found = nearest_on_edges(mesh.vertices[rows], border)
    near = found.distance_m <= reach_m
    vertices = mesh.vertices.copy()
    vertices[rows[near]] = found.feet[near]
    vertices[rows[near], plane.axis] = np.float32(plane.at_m)
    return _with_inserted(replace(mesh, vertices=vertices), plane, border, reach_m)


def nearest_on_edges(points: Float32, edges: Float32) -> OnEdges:
    """Return the nearest points on line segments, among those with the nearest midpoints.

    Args:
        points: float32 (N, 3).
        edges: float32 (E, 2, 3), E ≥ 1.
    """
    middles = edges.mean(axis=1)
    candidates = open3d_clouds.nearest(points, middles, min(_CANDIDATES, len(edges)))[0]
    begin = edges[candidates, 0].astype(np.float64)
    along = edges[candidates, 1] - begin
    to_point = points[:, None] - begin
    length2 = np.maximum(np.einsum("nki,nki->nk", along, along), 1e-30)
    share = np.clip(np.einsum("nki,nki->nk", to_point, along) / length2, 0, 1)
    feet = begin + share[..., None] * along
    distance_m = np.linalg.norm(points[:, None] - feet, axis=2)
    best = np.argmin(distance_m, axis=1)
    row = np.arange(len(points))
    edge = candidates[row, best].astype(np.int64)
    return OnEdges(edge, share[row, best], feet[row, best], distance_m[row, best])


def _with_inserted(
    mesh: TriangleMesh, plane: Plane, border: Float32, reach_m: float
) -> TriangleMesh:
    """Insert the vertices of a border into the boundary edges that they lie next to."""
    corners = _open_corners(mesh, plane)
    if not len(corners):
        return mesh
    points = np.unique(border.reshape(-1, 3), axis=0)
    ends = mesh.vertices[corners[:, :2]]
    found = nearest_on_edges(points, ends)
    to_ends_m = np.linalg.norm(points[:, None] - ends[found.edge], axis=2).min(axis=1)
    inside = (found.distance_m <= reach_m) & (found.share > 0) & (found.share < 1)
    inside &= to_ends_m > _SAME_M
    # In a triangle with two boundary edges, only the first takes new vertices.
    _, first = np.unique(corners[:, 3], return_index=True)
    inside &= np.isin(found.edge, first)
    chosen = np.flatnonzero(inside)
    chosen = chosen[np.lexsort((found.share[chosen], found.edge[chosen]))]
    new = (len(mesh.vertices) + np.arange(len(chosen))).astype(np.int32)
    edges = corners[found.edge[chosen], :2].astype(np.int32)
    grown = with_vertices(mesh, points[chosen], edges, found.share[chosen])
    return replace(grown, faces=_split_faces(mesh.faces, corners, found.edge[chosen], new))


def _split_faces(
    faces: Int32, corners: Int32, edge: np.ndarray[tuple[int], np.dtype[np.int64]], new: Int32
) -> Int32:
    """Split faces with new vertices on a boundary edge into fans around the opposite corner.

    Args:
        faces: int32 (F, 3).
        corners: Boundary edges from `_open_corners`.
        edge: int64 (N,), row of ``corners`` of each new vertex, ascending.
        new: int32 (N,), indices of the new vertices, in order along each edge.
    """
    kept = np.ones(len(faces), dtype=bool)
    fans = [faces[:0]]
    for row in np.unique(edge):
        first, last, opposite, face = corners[row]
        line = np.concatenate([[first], new[edge == row], [last]])
        kept[face] = False
        apex = np.full(len(line) - 1, opposite)
        fans.append(np.stack([line[:-1], line[1:], apex], axis=1).astype(np.int32))
    return np.concatenate([faces[kept], *fans])


def _open_corners(mesh: TriangleMesh, plane: Plane) -> Int32:
    """Return boundary edges in a plane: int32 (E, 4).

    First and last vertex in the order of the triangle, its third vertex, and its index.
    """
    number = np.repeat(np.arange(len(mesh.faces), dtype=np.int32), 3)
    turned = mesh.faces[:, [[0, 1, 2], [1, 2, 0], [2, 0, 1]]].reshape(-1, 3)
    inside = plane.holds(mesh.vertices)[turned[:, :2]].all(axis=1)
    turned, number = turned[inside], number[inside]
    _, where, count = np.unique(
        np.sort(turned[:, :2], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    single = count[where.ravel()] == 1
    return np.concatenate([turned[single], number[single, None]], axis=1).astype(np.int32)
