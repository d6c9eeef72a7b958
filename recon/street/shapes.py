"""Painted triangles, of which every scene consists, and simple shapes made of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry import se3
from recon.core.values.arrays import Float64, Int32, UInt8, freeze
from recon.street.kernels.surface import value_noise

FAR_UV = 100.0


def quads(
    origins: Any, edges_u: Any, edges_v: Any, paint: Paint, uv_origins: Any = (0.0, 0.0)
) -> TriangleSoup:
    """Return parallelograms in one paint, each (3,) or (N, 3): a corner, the edges from there.

    ``uv_origins``, (2,) or (N, 2), are the texture coordinates of that corner in metres.
    """
    edges = np.broadcast_arrays(*np.atleast_2d(origins, edges_u, edges_v))
    p, u, v = (each.astype(np.float64) for each in edges)
    corners = np.stack([p, p + u, p + u + v, p + v], axis=1)
    a = np.broadcast_to(np.asarray(uv_origins, dtype=np.float64), (len(p), 2))
    du = np.stack([np.linalg.norm(u, axis=1), np.zeros(len(p))], axis=1)
    dv = np.stack([np.zeros(len(p)), np.linalg.norm(v, axis=1)], axis=1)
    uv = np.stack([a, a + du, a + du + dv, a + dv], axis=1)
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    return painted(corners[:, halves].reshape(-1, 3, 3), uv[:, halves].reshape(-1, 3, 2), paint)


def boxes(low: Any, high: Any, paint: Paint) -> TriangleSoup:
    """Return axis-aligned boxes between corners ``low`` and ``high``, each (N, 3) or (3,)."""
    a, b = np.broadcast_arrays(*np.atleast_2d(low, high))
    x, y, z = (np.eye(3)[k] * (b - a) for k in range(3))
    sides = [(a, x, z), (a, y, z), (a + y, x, z), (a + x, y, z), (a + z, x, y), (a, x, y)]
    origins, edges_u, edges_v = (np.concatenate(part) for part in zip(*sides, strict=True))
    return quads(origins, edges_u, edges_v, paint)


def frustum(low: Any, high: Any, inset: tuple[float, float, float], paint: Paint) -> TriangleSoup:
    """Return the walls of a box whose top is narrower by ``inset``: at -x, +x and each side."""
    (x0, y0, z0), (x1, y1, z1), (back, front, side) = low, high, inset

    def rim(x0: float, x1: float, y0: float, y1: float, z: float) -> Float64:
        corners = [[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z], [x0, y0, z]]
        return np.array(corners, dtype=np.float64)

    bottom, top = rim(x0, x1, y0, y1, z0), rim(x0 + back, x1 - front, y0 + side, y1 - side, z1)
    walls = []
    for k in range(4):
        corners = band(bottom[k : k + 2], top[k : k + 2])
        walls.append(painted(corners, corners[..., [k % 2, 2]] + [FAR_UV * (k % 2), 0.0], paint))
    return merge(walls)


def cylinder(
    radii_m: tuple[float, float], height_m: float, paint: Paint, sides: int = 10
) -> TriangleSoup:
    """Return the lateral surface of an upright cone frustum at the origin, without caps."""
    angle, zero = np.linspace(0.0, 2.0 * np.pi, sides + 1), np.zeros(sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    corners = band(ring * radii_m[0], ring * radii_m[1] + [0.0, 0.0, height_m])
    foot, head = (np.stack([angle * radii_m[0], zero + v], axis=1) for v in (0.0, height_m))
    return painted(corners, band(foot, head), paint, band(ring, ring))


def disc(radius_m: float, paint: Paint, sides: int = 14) -> TriangleSoup:
    """Return a flat disc around the origin in the x-z plane."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    rim = np.stack([np.cos(angle), np.zeros(sides + 1), np.sin(angle)], axis=1)
    return _fan(np.zeros(3), radius_m * rim, paint)


def extrusion(profile: Any, width_m: float, paint: Paint) -> TriangleSoup:
    """Return a star-shaped profile (K, 2) of (x, z), extruded along y about y = 0, with caps."""
    closed = np.asarray([*profile, profile[0]], dtype=np.float64)
    left = np.stack([closed[:, 0], np.full(len(closed), width_m / 2), closed[:, 1]], axis=1)
    right = left * [1.0, -1.0, 1.0]
    along = np.cumsum([0.0, *np.linalg.norm(np.diff(closed, axis=0), axis=1)])
    # Far from the texture coordinates of the caps, so that patterns on the caps stay there.
    uv = [np.stack([FAR_UV + along, np.full(len(along), FAR_UV + y)], 1) for y in (0.0, width_m)]
    caps = [_fan(rim[:-1].mean(axis=0), rim, paint) for rim in (left, right)]
    return merge([painted(band(left, right), band(*uv), paint), *caps])


def _fan(middle: Float64, rim: Float64, paint: Paint) -> TriangleSoup:
    """Return triangles from a point (3,) to a polyline (N, 3), parallel to the x-z plane."""
    corners = np.stack([np.broadcast_to(middle, rim[1:].shape), rim[:-1], rim[1:]], axis=1)
    return painted(corners, corners[..., [0, 2]], paint)


def band(near: Float64, far: Float64) -> Float64:
    """Return triangles (2·(N-1), 3, C) between two polylines (N, C)."""
    first = np.stack([near[:-1], near[1:], far[1:]], axis=1)
    return np.concatenate([first, np.stack([near[:-1], far[1:], far[:-1]], axis=1)])


def bumpy_ball(radii_m: Any, paint: Paint, *, bump: float, wavelength: float) -> TriangleSoup:
    """Return an ellipsoid (semi-axes: 3) with bumps, such as the crown of a tree.

    Height and wavelength of the bumps are fractions of the radius; the paint's part seeds them.
    """
    flat, places = _icosphere_corners(3)
    hills = value_noise(flat / wavelength, paint.part)
    hills += 0.5 * value_noise(flat * (2.0 / wavelength), paint.part + 1)
    surface = flat * (1.0 + bump * hills)[:, None] * np.asarray(radii_m)
    corners = surface[places].reshape(-1, 3, 3)
    # Normals are the area-weighted mean of all triangles that meet at a corner.
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((int(places.max()) + 1, 3))
    np.add.at(total, places, np.repeat(flat, 3, axis=0))
    normals = _unit(total)[places].reshape(-1, 3, 3)
    return painted(corners, corners[..., :2].copy(), paint, normals)


@cache
def _icosphere_corners(splits: int) -> tuple[Float64, NDArray[np.int64]]:
    """Return corners (N, 3) of a unit sphere of 20·4^splits triangles, and which those have."""
    g = (1.0 + 5.0**0.5) / 2.0
    flat = np.array([[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0]])
    # Three golden rectangles, one in each coordinate plane.
    points = np.concatenate([np.roll(flat, turn, axis=1) for turn in (0, 1, 2)])
    faces = (
        "0 11 5 0 5 1 0 1 7 0 7 10 0 10 11 1 5 9 5 11 4 11 10 2 10 7 6 7 1 8 "
        "3 9 4 3 4 2 3 2 6 3 6 8 3 8 9 4 9 5 2 4 11 6 2 10 8 6 7 9 8 1"
    )
    corners = _unit(points[np.array(faces.split(), dtype=int).reshape(-1, 3)])
    for _ in range(splits):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = _unit(a + b), _unit(b + c), _unit(c + a)
        children = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(child, axis=1) for child in children])
    flat, places = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return flat, places.ravel()


def _unit(v: NDArray[Any]) -> Float64:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True), dtype=np.float64)


class Material(IntEnum):
    """Kinds of surface; `recon.street.materials` has a recipe for each."""

    PLAIN, ASPHALT, PAVING, KERB, PLASTER, BRICK, GLASS, DOOR = range(8)
    ROOF, CAR_PAINT, CAR_GLASS, BARK, LEAVES, METAL, GRASS, POSTER = range(8, 16)
    WHITE, MIRROR = range(16, 18)


@dataclass(frozen=True)
class Paint:
    """Appearance of a surface."""

    material: Material = Material.PLAIN  # the recipe
    rgb: tuple[float, float, float] = (0.5, 0.5, 0.5)  # base colour as displayed, each in [0, 1]
    part: int = 0  # number of the object, which seeds its variations


@dataclass(frozen=True, eq=False)
class TriangleSoup:
    """Triangles with their paint; they share no vertices."""

    vertices: Float64  # (F, 3, 3), corners, metres
    normals: Float64  # (F, 3, 3), unit normals at the corners, only for shading
    uv: Float64  # (F, 3, 2), texture coordinates of the corners, metres
    rgb: Float64  # (F, 3), base colour
    material: UInt8  # (F,), a `Material`
    part: Int32  # (F,), number of the object

    def __post_init__(self) -> None:
        n = len(self.vertices)
        for name, shape in (("vertices", (n, 3, 3)), ("normals", (n, 3, 3)), ("uv", (n, 3, 2))):
            freeze(self, name, np.float64, shape)
        freeze(self, "rgb", np.float64, (n, 3))
        freeze(self, "material", np.uint8, (n,))
        freeze(self, "part", np.int32, (n,))

    def __len__(self) -> int:
        return len(self.vertices)


def merge(soups: Iterable[TriangleSoup]) -> TriangleSoup:
    """Return all triangles of several soups, in order."""
    parts = zip(*(vars(soup).values() for soup in soups), strict=True)
    return TriangleSoup(*map(np.concatenate, parts))


def move(soup: TriangleSoup, T_to_from: Float64) -> TriangleSoup:
    """Transform triangles into other axes."""
    vertices = se3.apply(T_to_from, soup.vertices.reshape(-1, 3)).reshape(-1, 3, 3)
    normals = se3.rotate(T_to_from, soup.normals.reshape(-1, 3)).reshape(-1, 3, 3)
    return replace(soup, vertices=vertices, normals=normals)


def at(x: float, y: float, z: float, turn_rad: float = 0.0) -> Float64:
    """Return the transform that turns an object about z and moves it to a place."""
    return se3.make_transform(se3.exp_so3(np.array([0.0, 0.0, turn_rad])), np.array([x, y, z]))


def painted(
    vertices: Float64, uv: Float64, paint: Paint, normals: Float64 | None = None
) -> TriangleSoup:
    """Return triangles (F, 3, 3) in one paint, flat-shaded unless there are ``normals``."""
    n = len(vertices)
    if normals is None:
        flat = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        normals = np.repeat(flat[:, None, :], 3, axis=1)
    rgb = np.tile(np.array(paint.rgb, dtype=np.float64), (n, 1))
    material, part = np.full(n, paint.material, np.uint8), np.full(n, paint.part, np.int32)
    return TriangleSoup(vertices, normals, uv, rgb, material, part)
