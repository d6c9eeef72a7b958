"""A lit scene: finds what each ray hits, and its colour.

All surfaces are Lambertian and the light is static, so a point has the same colour from everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.open3d_raycasting import RayScene
from recon.core.values.arrays import Bool, Float64, Int32
from recon.street.kernels.surface import SurfaceHits, SurfaceTable, describe_hits
from recon.street.materials import albedo, sky_colour
from recon.street.soup import TriangleSoup

_SUN: Final = np.array([1.50, 1.38, 1.18])
_SKY: Final = np.array([0.52, 0.58, 0.68])
_SIGHT: Final = 1.0 - 1e-4  # fraction of a line of sight that must be free
_SKIN_M: Final = 2e-3  # shadow rays start this far above a surface
_REACH_M: Final = 80.0  # length of shadow rays
_SHELTER_M: Final = 1.0  # a horizontal surface with an object this close above sees little sky


class Sample(NamedTuple):
    """What rays hit."""

    rgb: Float64  # (N, 3), linear light
    normal: Float64  # (N, 3), shading normal; 0 for the sky
    label: NDArray[np.int64]  # (N,), differs between objects, materials, and shadow and light


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene with its light."""

    soup: TriangleSoup
    table: SurfaceTable  # the triangles, precomputed for hits
    rays: RayScene  # the triangles in the ray caster
    to_sun: Float64  # (3,), unit vector towards the sun
    seed: int  # of grain and clouds

    def depth(self, origin: Float64, directions: Float64) -> Float64:
        """Return float64 (N,), depth along rays of unit depth; NaN where they hit nothing."""
        faces = self.rays.first_hit(origin, directions)
        hit = faces >= 0
        depth = np.full(len(directions), np.nan)
        depth[hit] = plane_distance(self.table, faces[hit], origin, directions[hit])
        return depth

    def sees(self, origin: Float64, xyz: Float64) -> Bool:
        """Return bool (N,), whether the line of sight from ``origin`` to each point is free."""
        return ~self.rays.blocked(origin, xyz - origin, far=_SIGHT)

    def look(self, origin: Float64, directions: Float64, pixel: float) -> Sample:
        """Trace rays of unit depth, where a pixel is ``pixel`` wide, and shade what they hit."""
        faces = self.rays.first_hit(origin, directions)
        hit = np.flatnonzero(faces >= 0)
        sky = np.flatnonzero(faces < 0)
        rgb, normal = np.empty((len(faces), 3)), np.zeros((len(faces), 3))
        label = np.full(len(faces), -1, dtype=np.int64)
        rgb[sky] = sky_colour(directions[sky], pixel, self.seed)
        met = faces[hit]
        hits = describe_hits(self.table, met, origin, directions[hit], pixel)
        light, lit = self._light(hits)
        rgb[hit] = albedo(self.soup, met, hits, self.seed) * light
        normal[hit] = hits.normal
        part, material = self.soup.part[met], self.soup.material[met]
        label[hit] = (part.astype(np.int64) * 32 + material) * 2 + lit
        return Sample(rgb, normal, label)

    def _light(self, points: SurfaceHits) -> tuple[Float64, Bool]:
        """Return irradiance (N, 3) at points, and whether the sun reaches them."""
        start = points.xyz + _SKIN_M * points.normal
        facing = points.normal @ self.to_sun
        lit = facing > 0
        reach = np.broadcast_to(_REACH_M * self.to_sun, (int(lit.sum()), 3))
        lit[lit] = ~self.rays.blocked(start[lit], reach)
        openness = 0.72 + 0.28 * points.normal[:, 2]
        floor = np.flatnonzero(points.normal[:, 2] > 0.7)
        above = np.broadcast_to([0.0, 0.0, _SHELTER_M], (len(floor), 3))
        openness[floor[self.rays.blocked(start[floor], above)]] *= 0.4
        sun = np.where(lit, facing, 0.0)
        return openness[:, None] * _SKY + sun[:, None] * _SUN, lit


def make_stage(soup: TriangleSoup, to_sun: Float64, seed: int, threads: int = 0) -> Stage:
    """Prepare a scene for rendering."""
    return Stage(soup, surface_table(soup), RayScene(soup.vertices, threads), to_sun, seed)


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
