"""What a ray meets: place, orientation and surface coordinates, in double precision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.structures.arrays import Float64, Int32
from recon.synthetic.soup import TriangleSoup

# Beyond this ratio of its sides the footprint of a pixel is widened instead of lengthened.
_MAX_STRETCH = 24.0


@dataclass(frozen=True, eq=False)
class SurfaceTable:
    """Per triangle, all that is linear in a point on it.

    Attributes:
        anchor: float64 (F, 3), a corner.
        normal: float64 (F, 3), unit normal of the plane.
        to_uv: float64 (F, 2, 3); surface coordinates are ``uv + to_uv @ (xyz - anchor)``.
        uv: float64 (F, 2), at the anchor.
        to_shading: float64 (F, 3, 3), the same for the shading normal.
        shading: float64 (F, 3), at the anchor.
    """

    anchor: Float64
    normal: Float64
    to_uv: Float64
    uv: Float64
    to_shading: Float64
    shading: Float64


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points that rays met, with the footprint of the pixel on the surface.

    Attributes:
        faces: int32 (N,), triangle of each.
        xyz: float64 (N, 3), metres.
        normal: float64 (N, 3), unit shading normal towards the viewer.
        uv: float64 (N, 2), surface coordinates, metres.
        width: float64 (N,), short side of the footprint, metres.
        smear: float64 (N, 3), long side of the footprint, metres.
        spread: float64 (N, 2), extent of the footprint along u and v.
    """

    faces: Int32
    xyz: Float64
    normal: Float64
    uv: Float64
    width: Float64
    smear: Float64
    spread: Float64


def surface_table(soup: TriangleSoup) -> SurfaceTable:
    """Solve each triangle once, so that a hit costs a few products."""
    # The ray caster rounds corners to single precision; the planes must be those that it hits.
    corners = soup.vertices.astype(np.float32).astype(np.float64)
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    squared = np.maximum((normal**2).sum(axis=1, keepdims=True), 1e-24)
    gradients = np.stack([np.cross(e2, normal), np.cross(normal, e1)], axis=1)
    gradients /= squared[:, :, None]
    return SurfaceTable(
        anchor=a,
        normal=normal / np.sqrt(squared),
        to_uv=np.einsum("fkc,fkx->fcx", soup.uv[:, 1:] - soup.uv[:, :1], gradients),
        uv=soup.uv[:, 0].copy(),
        to_shading=np.einsum("fkc,fkx->fcx", soup.normals[:, 1:] - soup.normals[:, :1], gradients),
        shading=soup.normals[:, 0].copy(),
    )


def plane_distance(
    table: SurfaceTable, faces: Int32, origin: Float64, directions: Float64
) -> Float64:
    """Where rays pierce the planes of their triangles, in units of their directions (N,)."""
    normal = table.normal[faces]
    height = _dot(table.anchor[faces] - origin, normal)
    return np.asarray(height / _dot(directions, normal))


def surface_points(
    table: SurfaceTable, faces: Int32, origin: Float64, directions: Float64, pixel: float
) -> SurfacePoints:
    """Describe the points that rays meet.

    Args:
        table: Of the scene.
        faces: int32 (N,), the triangle that each ray meets.
        origin: (3,), centre of the camera.
        directions: (N, 3), of unit depth, so that their factor is the depth.
        pixel: Width of a pixel at unit depth (``1 / focal_px``).
    """
    depth = plane_distance(table, faces, origin, directions)
    xyz = origin + depth[:, None] * directions
    local = xyz - table.anchor[faces]
    to_uv = table.to_uv[faces]
    width, smear = _footprint(table.normal[faces], directions, depth * pixel)
    shading = table.shading[faces] + np.einsum("ncx,nx->nc", table.to_shading[faces], local)
    shading /= np.sqrt(_dot(shading, shading))[:, None]
    shading *= -np.sign(_dot(table.normal[faces], directions))[:, None]
    across = np.sqrt((to_uv**2).sum(axis=2)) * width[:, None]
    return SurfacePoints(
        faces=faces,
        xyz=xyz,
        normal=shading,
        uv=table.uv[faces] + np.einsum("ncx,nx->nc", to_uv, local),
        width=width,
        smear=smear,
        spread=np.hypot(across, np.einsum("ncx,nx->nc", to_uv, smear)),
    )


def _footprint(normal: Float64, directions: Float64, width: Float64) -> tuple[Float64, Float64]:
    """Short side (N,) and long side (N, 3) of a pixel on a plane."""
    view = directions / np.sqrt(_dot(directions, directions))[:, None]
    cosine = _dot(view, normal)
    along = view - cosine[:, None] * normal
    stretch = 1.0 / np.maximum(np.abs(cosine), 1.0 / 400.0)
    width = width * np.maximum(stretch / _MAX_STRETCH, 1.0)
    stretch = np.minimum(stretch, _MAX_STRETCH)
    # `along` has length sin; only what exceeds the short side is a smear.
    sine = np.maximum(np.sqrt(_dot(along, along)), 1e-9)
    return width, along * (width * np.sqrt(stretch**2 - 1.0) / sine)[:, None]


def _dot(a: Float64, b: Float64) -> Float64:
    return np.asarray(np.einsum("nx,nx->n", a, b))
