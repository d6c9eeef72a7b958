"""Precomputed triangles for fast evaluation of ray hits."""

from __future__ import annotations

import numpy as np

from recon.core.values.arrays import Float64, Int32
from recon.street.kernels.surface import SurfaceTable
from recon.street.soup import TriangleSoup


def surface_table(soup: TriangleSoup) -> SurfaceTable:
    """Precompute each triangle, so that a hit costs only a few products."""
    # The ray caster uses single precision; the planes must be exactly those that it hits.
    corners = soup.vertices.astype(np.float32).astype(np.float64)
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    squared = np.maximum((normal**2).sum(axis=1, keepdims=True), 1e-24)
    # Gradients of the two barycentric coordinates within the plane.
    gradients = np.stack([np.cross(e2, normal), np.cross(normal, e1)], axis=1)
    gradients /= squared[:, :, None]
    return SurfaceTable(
        anchor=a.copy(),
        normal=normal / np.sqrt(squared),
        to_uv=np.einsum("fkc,fkx->fcx", soup.uv[:, 1:] - soup.uv[:, :1], gradients),
        uv=soup.uv[:, 0].copy(),
        to_shading=np.einsum("fkc,fkx->fcx", soup.normals[:, 1:] - soup.normals[:, :1], gradients),
        shading=soup.normals[:, 0].copy(),
    )


def plane_distance(
    table: SurfaceTable, faces: Int32, origin: Float64, directions: Float64
) -> Float64:
    """Return distances (N,) of rays to the planes of their triangles, in their units."""
    normal = table.normal[faces]
    height = np.einsum("nx,nx->n", table.anchor[faces] - origin, normal)
    return np.asarray(height / np.einsum("nx,nx->n", directions, normal))
