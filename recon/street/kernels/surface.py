"""Where rays meet triangles: place, orientation, surface coordinates, footprint of the pixel."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel

MAX_STRETCH: Final = 24.0
"""Beyond this ratio of its sides a footprint is widened instead of lengthened."""
_MIN_COSINE: Final = 1.0 / 400.0

Float64 = NDArray[np.float64]


class SurfaceTable(NamedTuple):
    """Per triangle, all that is linear in a point on it."""

    anchor: Float64  # (F, 3), a corner
    normal: Float64  # (F, 3), unit normal of the plane
    to_uv: Float64  # (F, 2, 3); surface coordinates are ``uv + to_uv @ (xyz - anchor)``
    uv: Float64  # (F, 2), at the anchor
    to_shading: Float64  # (F, 3, 3), the same for the shading normal
    shading: Float64  # (F, 3), at the anchor


class SurfaceHits(NamedTuple):
    """Points that rays met, with the footprint of the pixel on the surface."""

    xyz: Float64  # (N, 3), metres
    normal: Float64  # (N, 3), unit shading normal towards the viewer
    uv: Float64  # (N, 2), surface coordinates, metres
    width: Float64  # (N,), short side of the footprint, metres
    smear: Float64  # (N, 3), long side of the footprint, metres; 0 when seen straight on
    spread: Float64  # (N, 2), extent of the footprint along u and v


@kernel
def describe_hits(
    table: SurfaceTable,
    faces: NDArray[np.int32],
    origin: Float64,
    directions: Float64,
    pixel: float,
) -> SurfaceHits:
    """Describe the points in which rays pierce the planes of the triangles that they meet.

    Directions are of unit depth, so that their factor is the depth; ``pixel`` is the width of a
    pixel there (``1 / focal_px``).
    """
    n = len(faces)
    xyz, normals, uvs = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 2))
    widths, smears, spreads = np.empty(n), np.empty((n, 3)), np.empty((n, 2))
    local = np.empty(3)
    for i in range(n):
        face = faces[i]
        normal, anchor, ray = table.normal[face], table.anchor[face], directions[i]
        along, height, length = 0.0, 0.0, 0.0
        for k in range(3):
            along += ray[k] * normal[k]
            height += (anchor[k] - origin[k]) * normal[k]
            length += ray[k] * ray[k]
        length = np.sqrt(length)
        depth = height / along
        cosine = along / length
        stretch = 1.0 / max(abs(cosine), _MIN_COSINE)
        width = depth * pixel * max(stretch / MAX_STRETCH, 1.0)
        stretch = min(stretch, MAX_STRETCH)
        # Only what exceeds the short side is a smear; the view's part in the plane has length sin.
        smear = width * np.sqrt(stretch * stretch - 1.0)
        smear /= max(np.sqrt(max(1.0 - cosine * cosine, 0.0)), 1e-9)
        widths[i] = width
        for k in range(3):
            xyz[i, k] = origin[k] + depth * ray[k]
            local[k] = xyz[i, k] - anchor[k]
            smears[i, k] = smear * (ray[k] / length - cosine * normal[k])
        size = 0.0
        for c in range(3):
            value = table.shading[face, c]
            for k in range(3):
                value += table.to_shading[face, c, k] * local[k]
            normals[i, c] = value
            size += value * value
        size = -np.sign(along) / np.sqrt(size)
        for c in range(3):
            normals[i, c] *= size
        for c in range(2):
            value, square, smeared = table.uv[face, c], 0.0, 0.0
            for k in range(3):
                gradient = table.to_uv[face, c, k]
                value += gradient * local[k]
                square += gradient * gradient
                smeared += gradient * smears[i, k]
            uvs[i, c] = value
            spreads[i, c] = np.sqrt(square * width * width + smeared * smeared)
    return SurfaceHits(xyz, normals, uvs, widths, smears, spreads)
