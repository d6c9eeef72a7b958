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
    p, u, v = np.broadcast_arrays(*np.atleast_2d(origins, edges_u, edges_v))
    p, u, v = p.astype(np.float64), u.astype(np.float64), v.astype(np.float64)
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
    """Return the four walls of a box that narrows towards the top.

    ``inset`` is that of the top at the back (-x), at the front (+x) and at each side.
    """
    (x0, y0, z0), (x1, y1, z1), (back, front, side) = low, high, inset
    bottom = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]], dtype=np.float64)
    xa, xb, ya, yb = x0 + back, x1 - front, y0 + side, y1 - side
    top = np.array([[xa, ya, z1], [xb, ya, z1], [xb, yb, z1], [xa, yb, z1]], dtype=np.float64)
    walls = []
    for k, n in ((0, 1), (1, 2), (2, 3), (3, 0)):
        corners = np.array([[bottom[k], bottom[n], top[n]], [bottom[k], top[n], top[k]]])
        walls.append(painted(corners, corners[..., [k % 2, 2]] + [FAR_UV * (k % 2), 0.0], paint))
    return merge(walls)


def cylinder(
    radii_m: tuple[float, float], height_m: float, paint: Paint, sides: int = 10
) -> TriangleSoup:
    """Return the lateral surface of an upright cone frustum at the origin, without caps."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides + 1)], axis=1)
    rise = np.array([0.0, 0.0, height_m])
    low, high = ring * radii_m[0], ring * radii_m[1] + rise
    around = angle * radii_m[0]
    a, b = slice(None, -1), slice(1, None)
    corners = _split(low[a], low[b], high[b], high[a])
    normals = _split(ring[a], ring[b], ring[b], ring[a])
    foot = np.stack([around, np.zeros(sides + 1)], axis=1)
    head = np.stack([around, np.full(sides + 1, height_m)], axis=1)
    return painted(corners, _split(foot[a], foot[b], head[b], head[a]), paint, normals)


def disc(radius_m: float, paint: Paint, sides: int = 14) -> TriangleSoup:
    """Return a flat disc around the origin in the x-z plane."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    rim = radius_m * np.stack([np.cos(angle), np.zeros(sides + 1), np.sin(angle)], axis=1)
    corners = np.stack([np.zeros((sides, 3)), rim[:-1], rim[1:]], axis=1)
    return painted(corners, corners[..., [0, 2]], paint)


def extrusion(profile: Any, width_m: float, paint: Paint) -> TriangleSoup:
    """Return a star-shaped profile (K, 2) of (x, z), extruded along y about y = 0, with caps."""
    outline = np.asarray(profile, dtype=np.float64)
    closed = np.vstack([outline, outline[:1]])
    left = np.stack([closed[:, 0], np.full(len(closed), width_m / 2), closed[:, 1]], axis=1)
    right = left * [1.0, -1.0, 1.0]
    steps = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    a, b = slice(None, -1), slice(1, None)
    mantle = _split(left[a], left[b], right[b], right[a])
    # Far from the texture coordinates of the caps, so that patterns on the caps stay there.
    uv = [np.stack([FAR_UV + along, np.full(len(along), FAR_UV + y)], 1) for y in (0.0, width_m)]
    parts = [painted(mantle, _split(uv[0][a], uv[0][b], uv[1][b], uv[1][a]), paint)]
    for rim in (left, right):
        middle = np.broadcast_to(rim[:-1].mean(axis=0), (len(outline), 3))
        cap = np.stack([middle, rim[:-1], rim[1:]], axis=1)
        parts.append(painted(cap, cap[..., [0, 2]], paint))
    return merge(parts)


def bumpy_ball(
    radii_m: Any, paint: Paint, *, bump: float, wavelength: float, seed: int, splits: int = 3
) -> TriangleSoup:
    """Return an ellipsoid (semi-axes: 3) with bumps, such as the crown of a tree.

    Height and wavelength of the bumps are fractions of the radius; ``splits`` is how often the
    faces of an icosahedron are split in four.
    """
    flat, places = _icosphere_corners(splits)
    hills = value_noise(flat / wavelength, seed)
    hills += 0.5 * value_noise(flat * (2.0 / wavelength), seed + 1)
    surface = flat * (1.0 + bump * hills)[:, None] * np.asarray(radii_m)
    corners = surface[places].reshape(-1, 3, 3)
    return painted(corners, corners[..., :2].copy(), paint, _smooth_normals(corners, places))


def _smooth_normals(corners: Float64, places: NDArray[np.int64]) -> Float64:
    """Return normals (F, 3, 3), the area-weighted mean of all triangles that meet at a corner."""
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((int(places.max()) + 1, 3))
    np.add.at(total, places, np.repeat(flat, 3, axis=0))
    return _unit(total)[places].reshape(-1, 3, 3)


@cache
def _icosphere_corners(splits: int) -> tuple[Float64, NDArray[np.int64]]:
    """Return the different corners (N, 3) of a unit sphere, and which its faces have."""
    flat, places = np.unique(icosphere(splits).reshape(-1, 3), axis=0, return_inverse=True)
    return flat, places.ravel()


def icosphere(splits: int) -> Float64:
    """Return triangles (20·4^splits, 3, 3) of a unit sphere."""
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
    return corners


def _unit(v: NDArray[Any]) -> Float64:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True), dtype=np.float64)


def _split(a: Float64, b: Float64, c: Float64, d: Float64) -> Float64:
    """Return two triangles per quad a b c d."""
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


class Material(IntEnum):
    """Kinds of surface; `recon.street.materials` has a recipe for each."""

    PLAIN, ASPHALT, PAVING, KERB, PLASTER, BRICK, GLASS, DOOR = range(8)
    ROOF, CAR_PAINT, CAR_GLASS, BARK, LEAVES, METAL, GRASS, POSTER = range(8, 16)


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
        freeze(self, "vertices", np.float64, (None, 3, 3))
        n = len(self.vertices)
        freeze(self, "normals", np.float64, (n, 3, 3))
        freeze(self, "uv", np.float64, (n, 3, 2))
        freeze(self, "rgb", np.float64, (n, 3))
        freeze(self, "material", np.uint8, (n,))
        freeze(self, "part", np.int32, (n,))

    def __len__(self) -> int:
        return len(self.vertices)


def merge(soups: Iterable[TriangleSoup]) -> TriangleSoup:
    """Return all triangles of several soups, in order."""
    parts = list(soups)
    names = ("vertices", "normals", "uv", "rgb", "material", "part")
    return TriangleSoup(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def move(soup: TriangleSoup, T_to_from: Float64) -> TriangleSoup:
    """Transform triangles into other axes."""
    vertices = se3.apply(T_to_from, soup.vertices.reshape(-1, 3)).reshape(-1, 3, 3)
    normals = se3.rotate(T_to_from, soup.normals.reshape(-1, 3)).reshape(-1, 3, 3)
    return replace(soup, vertices=vertices, normals=normals)


def painted(
    vertices: Float64, uv: Float64, paint: Paint, normals: Float64 | None = None
) -> TriangleSoup:
    """Return triangles (F, 3, 3) with texture coordinates (F, 3, 2), all in one paint.

    Without ``normals`` they are flat-shaded.
    """
    n = len(vertices)
    return TriangleSoup(
        vertices=vertices,
        normals=_flat_normals(vertices) if normals is None else normals,
        uv=uv,
        rgb=np.tile(np.array(paint.rgb, dtype=np.float64), (n, 1)),
        material=np.full(n, paint.material, dtype=np.uint8),
        part=np.full(n, paint.part, dtype=np.int32),
    )


def _flat_normals(vertices: Float64) -> Float64:
    normal = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.repeat(normal[:, None, :], 3, axis=1)
