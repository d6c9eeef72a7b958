"""Painted triangles, of which every synthetic scene consists."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from recon.core.geometry import se3
from recon.core.values.arrays import Float64, Int32, UInt8, freeze


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
    material: UInt8  # uint8 (F,), a `Material`
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
