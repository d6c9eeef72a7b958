"""A mesh cut into charts, each a piece of surface as it is seen along an axis, side by side."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import MeshingError
from recon.core.open3d_raycasting import RayScene
from recon.core.values import TriangleMesh
from recon.core.values.arrays import Float32, Float64, Int32, Int64
from recon.export.mesh.cut import components, meeting_sides

_RIGHT: Final = np.array([[0, 1, 0], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [1, 0, 0], [1, 0, 0]])
_DOWN: Final = np.array([[0, 0, -1], [0, 0, -1], [0, -1, 0], [0, 0, -1], [0, 0, -1], [0, 1, 0]])
"""(6, 3), how what faces +x, +y, +z, -x, -y and -z lies in the picture: as seen from outside."""
_FACING: Final = np.concatenate([np.eye(3), -np.eye(3)])
_SLANTED: Final = 0.3  # least cosine to the axis of a chart: texels are stretched three times there
_SMOOTHINGS: Final = 3  # rounds in which faces join the charts of their neighbours
_CRUMB_PX: Final = 64  # a chart that covers less than a square as wide joins another, if it can,
_JOININGS: Final = 6  # in so many rounds,
_ASLANT: Final = 0.1  # as far as its cosines allow: few of its texels are ever seen
_SHOWN: Final = 0.7  # of the area of a face, texels: with fewer, another one of its chart hides it
_BLOCK_PX: Final = 256  # charts are cut into blocks as wide, to fit closely side by side
MARGIN_PX: Final = 2  # around a chart, painted with what is next to it
_ROWS: Final = 256  # of texels that are located at a time


@dataclass(frozen=True, eq=False)
class Atlas:
    """The charts of a mesh in one picture."""

    mesh: TriangleMesh  # with a vertex for each chart that one is in
    vertex_of: Int64  # (V,), the vertex of the mesh without charts
    places: Float64  # (V, 2), column and row of each vertex, texels from the upper left corner
    width_px: int
    height_px: int
    texel_m: float  # edge of a texel

    @cached_property
    def sides(self) -> Float64:
        """float64 (7, F): first corner of each face, the ways to both others, and their product."""
        a, b, c = self.places[self.mesh.faces].transpose(1, 2, 0)
        (ux, uy), (vx, vy) = b - a, c - a
        area = ux * vy - uy * vx
        area = np.where(np.abs(area) < 1e-12, 1.0, area)  # on edge, as a ray may just hit one
        return np.stack([*a, ux, uy, vx, vy, area])


def make_atlas(mesh: TriangleMesh, texel_m: float, most_px: int) -> Atlas:
    """Lay out the charts of a mesh; texels grow until the picture is at most ``most_px`` wide.

    Raises:
        MeshingError: They would be wider than its triangles: vertices show as much.
    """
    surface = _directions(mesh)
    a, b = mesh.vertices[mesh.faces[:, :2]].transpose(1, 0, 2)
    widest_m = max(texel_m, float(np.median(np.linalg.norm(b - a, axis=1))))
    while True:
        own, kind = _kinds(mesh, surface, texel_m)
        atlas = _laid_out(mesh, surface.pairs, kind, texel_m)
        if max(atlas.width_px, atlas.height_px) <= most_px:
            kind = _apart(atlas, surface.pairs, own, kind)
            atlas = _laid_out(mesh, surface.pairs, kind, texel_m)
        most = max(atlas.width_px, atlas.height_px)
        if most <= most_px:
            return atlas
        texel_m *= 1.02 * most / most_px
        if texel_m > widest_m:
            what, got = "the surface does not fit into a picture", f"texels of {texel_m:.3g} m"
            hint = f"raise mesh.texture_px ({most_px}), or mesh.min_component_faces"
            raise MeshingError(what, got=got, expected=f"{widest_m:.3g} m", hint=hint)


def texels_of(atlas: Atlas) -> tuple[Int32, Int32]:
    """Return number (N,), row by row, of the texels that a face covers; and its number (N,)."""
    corners = np.zeros((*atlas.mesh.faces.shape, 3), np.float32)
    corners[..., :2] = atlas.places[atlas.mesh.faces]
    scene, down = RayScene(corners), np.array([0.0, 0.0, -1.0])
    numbers, faces = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)]
    for first in range(0, atlas.height_px, _ROWS):
        rows, columns = np.mgrid[first : min(first + _ROWS, atlas.height_px), : atlas.width_px]
        above = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5, np.ones(rows.size)], axis=1)
        found = scene.first_hit(above, np.broadcast_to(down, above.shape))
        hit = np.flatnonzero(found >= 0)
        numbers.append((first * atlas.width_px + hit).astype(np.int32))
        faces.append(found[hit])
    return np.concatenate(numbers), np.concatenate(faces)


def ratios_of(atlas: Atlas, numbers: Int32, faces: Int32) -> Float32:
    """Return float32 (N, 3), how much each corner of its face counts at the centre of a texel."""
    x, y, ux, uy, vx, vy, area = atlas.sides.take(faces, axis=1)
    wx, wy = numbers % atlas.width_px + 0.5 - x, numbers // atlas.width_px + 0.5 - y
    second, third = (wx * vy - wy * vx) / area, (ux * wy - uy * wx) / area
    ratios = np.stack([1 - second - third, second, third], axis=1)
    return np.asarray(np.clip(ratios, 0, 1), np.float32)


class _Surface(NamedTuple):
    """Faces as charts are made of them."""

    pairs: Int64  # (P, 2), those that share an edge
    facing: Int64  # (F,), by which axis each is seen
    cosines: Float64  # (F, 6), how much it faces each axis
    area: Float64  # (F,)


def _directions(mesh: TriangleMesh) -> _Surface:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    double = np.linalg.norm(normals, axis=1)
    cosines = normals @ _FACING.T / np.maximum(double, 1e-30)[:, None]
    facing, pairs, rows = cosines.argmax(axis=1), meeting_sides(mesh.faces) // 3, np.arange(len(a))
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    for _ in range(_SMOOTHINGS):
        votes = np.bincount(6 * ends[:, 0] + facing[ends[:, 1]], minlength=6 * len(a))
        votes = votes.reshape(-1, 6).astype(np.float64)
        votes[rows, facing] += 0.5  # of two that are equal, its own
        facing = np.where(cosines >= _SLANTED, votes, -1).argmax(axis=1)
    return _Surface(pairs, facing, cosines, double / 2)


def _kinds(mesh: TriangleMesh, surface: _Surface, texel_m: float) -> tuple[Int64, Int64]:
    """Return int64 (F,), six times its block and the axis that each face is seen by: two of them.

    Those that meet and have the same one are a chart. In the second, crumbs joined other charts.
    """
    pairs, facing, cosines, area = surface
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    block = np.floor(middles / (_BLOCK_PX * texel_m)).astype(np.int64)
    own = kind = np.unique(block, axis=0, return_inverse=True)[1].ravel() * 6 + facing
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    for _ in range(_JOININGS):
        chart = _charts(pairs, kind)
        size = np.bincount(chart, area)
        begin, end = chart[ends].T
        joins = (size[begin] < (_CRUMB_PX * texel_m) ** 2) & (size[end] > size[begin])
        order = np.flatnonzero(joins)[np.argsort(size[end[joins]], kind="stable")]
        # The last assignment holds: of those that a crumb meets, the largest.
        into = np.full(len(size), -1)
        into[begin[order]] = kind[ends[order, 1]]
        into = into[chart]
        joins = (into >= 0) & (cosines[np.arange(len(into)), into % 6] >= _ASLANT)
        kind = np.where(joins, into, kind)
    return own, kind


def _charts(pairs: Int64, kind: Int64) -> Int32:
    return components(pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]], len(kind))


def _apart(atlas: Atlas, pairs: Int64, own: Int64, kind: Int64) -> Int64:
    """Return the kinds of faces, crumbs as before they joined charts that they overlap with."""
    numbers, faces = texels_of(atlas)
    shown, area = np.bincount(faces, minlength=len(kind)), np.abs(atlas.sides[-1]) / 2
    hidden = np.flatnonzero((area > 3) & (shown < _SHOWN * area))
    front = np.full(atlas.width_px * atlas.height_px, -1, np.int32)
    front[numbers] = faces
    column, row = atlas.places[atlas.mesh.faces[hidden]].mean(axis=1).astype(np.int64).T
    joined = kind != own
    guilty = np.where(joined[hidden], hidden, front[row * atlas.width_px + column])
    chart = _charts(pairs, own)
    return np.where(np.isin(chart, chart[guilty[guilty >= 0]]), own, kind)


def _laid_out(mesh: TriangleMesh, pairs: Int64, kind: Int64, texel_m: float) -> Atlas:
    chart_of_face, facing = _charts(pairs, kind), kind % 6
    charts = int(chart_of_face.max()) + 1
    packed = (chart_of_face.astype(np.int64)[:, None] << 32) | mesh.faces
    keys, faces = np.unique(packed, return_inverse=True)
    chart, vertex = keys >> 32, keys & 0xFFFFFFFF
    side = np.zeros(charts, np.int64)
    side[chart_of_face] = facing
    xyz = mesh.vertices[vertex].astype(np.float64)
    flat = [np.einsum("ij,ij->i", xyz, way[side[chart]]) / texel_m for way in (_RIGHT, _DOWN)]
    places = np.stack(flat, axis=1)
    low, high = np.full((charts, 2), np.inf), np.full((charts, 2), -np.inf)
    np.minimum.at(low, chart, places)
    np.maximum.at(high, chart, places)
    sizes = np.ceil(high - low).astype(np.int64) + 1 + 2 * MARGIN_PX
    corners, (width_px, height_px) = _packed(sizes)
    places += (corners - low + MARGIN_PX + 0.5)[chart]
    split = replace(
        mesh,
        vertices=mesh.vertices[vertex],
        faces=faces.reshape(-1, 3).astype(np.int32),
        normals=None if mesh.normals is None else mesh.normals[vertex],
        rgb=None if mesh.rgb is None else mesh.rgb[vertex],
    )
    return Atlas(split, vertex, places, width_px, height_px, texel_m)


def _packed(sizes: Int64) -> tuple[Int64, tuple[int, int]]:
    """Return the upper left corners (C, 2) of boxes of sizes (C, 2) on shelves; and the size."""
    # A tenth for what is left over at the ends of shelves.
    width = max(int(sizes[:, 0].max()), math.ceil(math.sqrt(1.1 * float(sizes.prod(axis=1).sum()))))
    corners, x, y, shelf = np.zeros_like(sizes), 0, 0, 0
    for chart in np.argsort(-sizes[:, 1], kind="stable"):
        wide, high = sizes[chart].tolist()
        if x + wide > width:
            x, y, shelf = 0, y + shelf, 0
        corners[chart], x, shelf = (x, y), x + wide, max(shelf, high)
    return corners, (width, y + shelf)
