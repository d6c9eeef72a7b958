"""Meshes cut along planes, joined there again, and trimmed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MeshingError
from recon.core.values import TriangleMesh
from recon.core.values.arrays import Bool, Float32, Float64, Int32, Int64
from recon.map.occupancy.bodies import pieces_of
from recon.stereo import open3d_clouds

_CANDIDATES: Final = 8
_SAME_M: Final = 1e-5
Places = np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True)
class Plane:
    """A plane perpendicular to an axis (0 = x), at a coordinate on it."""

    axis: int
    at_m: float

    def holds(self, vertices: Float32) -> Bool:
        """Return bool (V,): vertices that lie exactly in the plane, as those of a cut do."""
        return np.asarray(vertices[:, self.axis] == np.float32(self.at_m))


def cut_mesh(mesh: TriangleMesh, plane: Plane, *, keep_above: bool) -> TriangleMesh:
    """Return the part of a mesh above or below a plane, perhaps none; what crosses it is split.

    Two meshes of one surface, cut along the same plane, meet there without overlap: new vertices
    lie exactly in the plane. Their normals and colours are interpolated.
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
    split = ((one[:, 0], a, b), (two[:, 0], two[:, 1], c), (two[:, 0], c, d))
    faces = np.concatenate([whole, *(np.stack(corners, axis=1) for corners in split)])
    first, last = edges.T
    ratio = (away[first] / (away[first] - away[last])).astype(np.float64)
    met = between(mesh.vertices, edges, ratio).astype(np.float32)
    met[:, plane.axis] = np.float32(plane.at_m)
    return with_faces(with_vertices(mesh, met, edges, ratio), faces.astype(np.int32))


def with_vertices(mesh: TriangleMesh, new: Float32, edges: Int32, ratio: Float64) -> TriangleMesh:
    """Add vertices (N, 3) at fractions of edges (N, 2); normals and colours are interpolated."""
    normals, rgb = mesh.normals, mesh.rgb
    if normals is not None:
        mixed = between(normals, edges, ratio)
        mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12)
        normals = np.concatenate([normals, mixed.astype(np.float32)])
    if rgb is not None:
        rgb = np.concatenate([rgb, np.rint(between(rgb, edges, ratio)).astype(np.uint8)])
    return TriangleMesh(np.concatenate([mesh.vertices, new]), mesh.faces, normals, rgb)


def between(values: NDArray[Any], edges: Int32, ratio: Float64) -> Float64:
    """Return float64 (N, 3): vertex values (V, 3), interpolated linearly along edges."""
    first, last = values[edges[:, 0]], values[edges[:, 1]]
    return np.asarray((1 - ratio[:, None]) * first + ratio[:, None] * last)


def _first_turned(faces: Int32, inside: Bool, corners: int) -> Int32:
    """Return faces (F, 3), each rotated so that its ``corners`` corners inside come first."""
    # The odd corner comes first if it is inside, last if it is outside.
    odd = inside[faces] == (corners == 1)
    start = (np.argmax(odd, axis=1) + corners - 1) % 3
    order = (start[:, None] + np.arange(3)) % 3
    return np.asarray(np.take_along_axis(faces, order, axis=1), dtype=np.int32)


def with_faces(mesh: TriangleMesh, faces: Int32) -> TriangleMesh:
    """Return the faces with the vertices that they use; degenerate faces of a cut are dropped."""
    a, b, c = faces.T
    used, faces = renumbered(faces[(a != b) & (b != c) & (c != a)])
    normals = None if mesh.normals is None else mesh.normals[used]
    rgb = None if mesh.rgb is None else mesh.rgb[used]
    return TriangleMesh(mesh.vertices[used], faces, normals, rgb)


class OnEdges(NamedTuple):
    """Projections of points onto line segments."""

    edge: Places  # the segments
    ratio: Float64  # places on them, from 0 to 1
    feet: Float64  # (N, 3), the projected points
    distance_m: Float64  # of these from the points


def close_seam(mesh: TriangleMesh, plane: Plane, border: Float32, reach_m: float) -> TriangleMesh:
    """Fit a mesh to the border (E, 2, 3) of its neighbour, cut along the same plane.

    The vertices of the mesh move onto the border, and those of the border are inserted into the
    mesh, so that both follow the same line; gaps wider than ``reach_m`` stay.
    """
    rows = np.flatnonzero(plane.holds(mesh.vertices))
    if not len(rows) or not len(border):
        return mesh
    found = nearest_on_edges(mesh.vertices[rows], border)
    near = found.distance_m <= reach_m
    vertices = mesh.vertices.copy()
    vertices[rows[near]] = found.feet[near]
    vertices[rows[near], plane.axis] = np.float32(plane.at_m)
    mesh = replace(mesh, vertices=vertices)
    corners = open_corners(mesh, plane)
    if not len(corners):
        return mesh
    # The vertices of the border go into the boundary edges that they lie next to.
    points = np.unique(border.reshape(-1, 3), axis=0)
    ends = mesh.vertices[corners[:, :2]]
    found = nearest_on_edges(points, ends)
    to_ends_m = np.linalg.norm(points[:, None] - ends[found.edge], axis=2).min(axis=1)
    inside = (found.distance_m <= reach_m) & (found.ratio > 0) & (found.ratio < 1)
    inside &= to_ends_m > _SAME_M
    # In a triangle with two boundary edges, only the first takes new vertices.
    _, first = np.unique(corners[:, 3], return_index=True)
    inside &= np.isin(found.edge, first)
    chosen = np.flatnonzero(inside)
    chosen = chosen[np.lexsort((found.ratio[chosen], found.edge[chosen]))]
    new = (len(mesh.vertices) + np.arange(len(chosen))).astype(np.int32)
    edges = corners[found.edge[chosen], :2].astype(np.int32)
    grown = with_vertices(mesh, points[chosen], edges, found.ratio[chosen])
    return replace(grown, faces=_split_faces(mesh.faces, corners, found.edge[chosen], new))


def nearest_on_edges(points: Float32, edges: Float32) -> OnEdges:
    """Return the nearest points on edges (E, 2, 3), among those with the nearest midpoints."""
    middles = edges.mean(axis=1)
    candidates = open3d_clouds.nearest(points, middles, min(_CANDIDATES, len(edges)))[0]
    begin = edges[candidates, 0].astype(np.float64)
    along = edges[candidates, 1] - begin
    to_point = points[:, None] - begin
    length2 = np.maximum(np.einsum("nki,nki->nk", along, along), 1e-30)
    ratio = np.clip(np.einsum("nki,nki->nk", to_point, along) / length2, 0, 1)
    feet = begin + ratio[..., None] * along
    distance_m = np.linalg.norm(points[:, None] - feet, axis=2)
    best = np.argmin(distance_m, axis=1)
    row = np.arange(len(points))
    edge = candidates[row, best].astype(np.int64)
    return OnEdges(edge, ratio[row, best], feet[row, best], distance_m[row, best])


def _split_faces(faces: Int32, corners: Int32, edge: Places, new: Int32) -> Int32:
    """Split faces with new vertices on boundary edges, ascending, into fans."""
    kept = np.ones(len(faces), dtype=bool)
    fans = [faces[:0]]
    for row in np.unique(edge):
        first, last, opposite, face = corners[row]
        line = np.concatenate([[first], new[edge == row], [last]])
        kept[face] = False
        apex = np.full(len(line) - 1, opposite)
        fans.append(np.stack([line[:-1], line[1:], apex], axis=1).astype(np.int32))
    return np.concatenate([faces[kept], *fans])


def open_corners(mesh: TriangleMesh, plane: Plane) -> Int32:
    """Return boundary edges in a plane, int32 (E, 4): ends, third vertex and number of the face."""
    held = plane.holds(mesh.vertices)
    rows = np.flatnonzero(held[mesh.faces].sum(axis=1) >= 2).astype(np.int32)
    number = np.repeat(rows, 3)
    turned = mesh.faces[rows][:, [[0, 1, 2], [1, 2, 0], [2, 0, 1]]].reshape(-1, 3)
    inside = held[turned[:, :2]].all(axis=1)
    turned, number = turned[inside], number[inside]
    _, where, count = np.unique(
        np.sort(turned[:, :2], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    single = count[where.ravel()] == 1
    return np.concatenate([turned[single], number[single, None]], axis=1).astype(np.int32)


def keep_vertices(vertices: Float32, faces: Int32, keep: Bool) -> tuple[Float32, Int32]:
    """Return vertices and faces of the part whose faces have all vertices in ``keep``."""
    return _without_loose(vertices, faces[keep[faces].all(axis=1)])


def drop_small_components(vertices: Float32, faces: Int32, min_faces: int) -> tuple[Float32, Int32]:
    """Return the connected pieces of a mesh that have at least ``min_faces`` faces."""
    if min_faces <= 1:
        return _without_loose(vertices, faces)
    labels, sizes = component_labels(faces)
    return _without_loose(vertices, faces[sizes[labels] >= min_faces])


def component_labels(faces: Int32) -> tuple[Int32, Int32]:
    """Return int32 (F,), component of each face, in order of first faces; their sizes (C,)."""
    labels = components(meeting_sides(faces) // 3, len(faces))
    return labels, np.bincount(labels).astype(np.int32)


def components(pairs: Int64, count: int) -> Int32:
    """Return int32 (count,), the connected part of each of ``count`` things, given pairs (P, 2)."""
    return pieces_of(count, pairs).astype(np.int32)


def meeting_sides(faces: NDArray[np.signedinteger]) -> Int64:
    """Return int64 (P, 2), sides that are one edge; 3f + k begins at corner k of face f."""
    begin, end = faces.astype(np.int64), np.roll(faces, -1, axis=1)
    packed = ((np.minimum(begin, end) << 32) | np.maximum(begin, end)).ravel()
    order = np.argsort(packed, kind="stable")
    same = np.flatnonzero(packed[order][1:] == packed[order][:-1])
    return np.stack([order[same], order[same + 1]], axis=1)


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


def _without_loose(vertices: Float32, faces: Int32) -> tuple[Float32, Int32]:
    if len(faces) == 0:
        hint = "raise mesh.depth or mesh.max_distance_spacings, or filter less"
        raise MeshingError("trimming left no face of the surface", hint=hint)
    used, faces = renumbered(faces)
    return vertices[used], faces


def renumbered(faces: Int32) -> tuple[Int32, Int32]:
    """Return int32 (V,): vertices that faces (F, 3) use, ascending; and the faces with these."""
    used = np.flatnonzero(np.bincount(faces.ravel())).astype(np.int32)
    numbers = np.zeros(used.max(initial=-1) + 1, np.int32)
    numbers[used] = np.arange(len(used))
    return used, numbers[faces]
