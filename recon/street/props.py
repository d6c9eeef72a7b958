"""Objects in a street: parked cars, trees, lamp posts, signs, bollards, bins, fences and others.

Axes of an object: x along the street, y left, z up, its base at z = 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from recon.core.geometry import se3
from recon.street.shapes import (
    FAR_UV,
    Material,
    Paint,
    TriangleSoup,
    at,
    boxes,
    bumpy_ball,
    cylinder,
    disc,
    extrusion,
    frustum,
    merge,
    move,
    quads,
)

_PAINTS = [
    (0.62, 0.63, 0.65), (0.12, 0.13, 0.15), (0.82, 0.82, 0.80), (0.55, 0.10, 0.10),
    (0.13, 0.22, 0.42), (0.34, 0.36, 0.38), (0.22, 0.34, 0.26), (0.72, 0.66, 0.48),
]  # fmt: skip
_WHITE, _RED = (0.85, 0.85, 0.80), (0.55, 0.06, 0.05)
_POSTERS = [(0.62, 0.30, 0.22), (0.25, 0.42, 0.62), (0.66, 0.58, 0.25), (0.35, 0.52, 0.36)]


def car(rng: np.random.Generator) -> TriangleSoup:
    """Return a parked saloon, hatchback or van, facing along x."""
    part = _part(rng)
    colour = _PAINTS[rng.integers(len(_PAINTS))]
    van = rng.random() < 0.18
    length = float(rng.uniform(4.6, 5.0) if van else rng.uniform(3.9, 4.5))
    height = float(rng.uniform(1.9, 2.05) if van else rng.uniform(1.42, 1.55))
    width = float(rng.uniform(1.72, 1.85))
    paint, a = Paint(Material.CAR_PAINT, colour, part), length / 2
    boot = [(-a + 0.06, 0.92)] if van else [(-a + 0.55, 0.97), (-a + 0.08, 0.9)]
    profile = [(-a + 0.05, 0.24), (a - 0.1, 0.2), (a, 0.36), (a - 0.03, 0.62), (a - 0.25, 0.76)]
    profile += [(a - 1.05, 0.93), (0.0, 0.97), *boot, (-a, 0.6)]
    parts = [extrusion(profile, width, paint), _cabin(length, width, height, paint, van)]
    y = 0.5 * width
    parts += [_wheel(x, side, part) for x in (-0.3 * length, 0.31 * length) for side in (-y, y)]
    plate = Paint(Material.POSTER, (0.80, 0.80, 0.72), part + 5)
    for x, rgb, lamp in ((a + 0.01, _WHITE, part + 3), (-(a + 0.01), _RED, part + 4)):
        lows = [[x, -width / 2 + 0.05, 0.56], [x, width / 2 - 0.45, 0.56]]
        parts.append(quads(lows, [0, 0.4, 0], [0, 0, 0.16], Paint(Material.PLAIN, rgb, lamp)))
        parts.append(quads([x, -0.26, 0.38], [0, 0.52, 0], [0, 0, 0.12], plate))
    return merge(parts)


def _part(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 2**30))


def _cabin(length: float, width: float, height: float, paint: Paint, van: bool) -> TriangleSoup:
    a, side, front = length / 2, 0.14, 0.75
    back = 0.12 if van else 0.4
    low = np.array([-a + (0.06 if van else 0.35), -width / 2 + 0.03, 0.9])
    high = np.array([a - 1.0, width / 2 - 0.03, height])
    glass = Paint(Material.CAR_GLASS, paint.rgb, paint.part)
    corner = np.array([low[0] + back, low[1] + side, height])
    size = high - low - np.array([back + front, 2 * side, 0.0])
    roof = quads(corner, [size[0], 0, 0], [0, size[1], 0], paint, FAR_UV)
    return merge([frustum(low, high, (back, front, side), glass), roof])


def _wheel(x: float, y: float, part: int) -> TriangleSoup:
    tyre = Paint(Material.PLAIN, (0.11, 0.11, 0.12), part + 1)
    rim = Paint(Material.METAL, (0.55, 0.56, 0.58), part + 2)
    # The tyre protrudes 1 cm from the body, the rim 1 cm from the tyre.
    out = float(np.sign(y))
    outer = move(disc(0.31, tyre), at(x, y + 0.01 * out, 0.31))
    inner = move(disc(0.19, rim), at(x, y + 0.02 * out, 0.31))
    lying = at(x, y + 0.01 * out, 0.31)
    lying[:3, :3] = se3.exp_so3(np.array([out * np.pi / 2, 0.0, 0.0]))
    return merge([outer, inner, move(cylinder((0.31, 0.31), 0.2, tyre, 14), lying)])


def tree(rng: np.random.Generator) -> TriangleSoup:
    """Return a tree: a trunk and a crown of several bumpy balls."""
    part, height = _part(rng), float(rng.uniform(2.1, 2.9))
    bark = Paint(Material.BARK, (0.36, 0.30, 0.24), part)
    parts = [cylinder((0.17, 0.11), height + 0.8, bark, 12)]
    green = np.array([0.30, 0.42, 0.17]) + rng.normal(0, 0.03, 3)
    spread = float(rng.uniform(1.1, 1.5))
    for k in range(int(rng.integers(5, 8))):
        radii = spread * rng.uniform(0.55, 0.85) * np.array([1.0, 1.0, 0.85])
        away = rng.normal(0.0, 0.42, 3) * spread * [1.0, 1.0, 0.7]
        away[2] = abs(away[2]) * 1.3 + 0.75 * spread
        shade = tuple(float(c) for c in np.clip(green * rng.uniform(0.85, 1.15), 0, 1))
        leaves = Paint(Material.LEAVES, (shade[0], shade[1], shade[2]), part + k)
        ball = bumpy_ball(radii, leaves, bump=0.22, wavelength=0.28)
        parts.append(move(ball, at(away[0], away[1], away[2] + height)))
    return merge(parts)


def lamp_post(side: float, rng: np.random.Generator) -> TriangleSoup:
    """Return a 6 m post with an arm over the road, which is towards ``-side``."""
    paint = Paint(Material.METAL, (0.30, 0.33, 0.32), _part(rng))
    parts = [cylinder((0.13, 0.11), 0.9, paint, 12), cylinder((0.08, 0.05), 6.0, paint, 10)]
    for ends, x, z0, z1 in (((0.0, 1.4), 0.04, 5.9, 5.98), ((1.0, 1.6), 0.14, 5.8, 5.92)):
        y0, y1 = sorted(0.0 - side * y for y in ends)
        parts.append(boxes([-x, y0, z0], [x, y1, z1], paint))
    return merge(parts)


def sign(rng: np.random.Generator) -> TriangleSoup:
    """Return a round or square traffic sign on a thin pole, facing backwards along x."""
    part = _part(rng)
    pole = cylinder((0.035, 0.035), 2.9, Paint(Material.METAL, (0.55, 0.56, 0.57), part), 8)
    if rng.random() < 0.5:
        blue = Paint(Material.POSTER, (0.16, 0.30, 0.62), part)
        return merge([pole, boxes([-0.08, -0.3, 2.2], [-0.045, 0.3, 2.85], blue)])
    rings = [pole]
    for x, radius, rgb in ((-0.05, 0.33, (0.70, 0.10, 0.10)), (-0.055, 0.23, (0.88, 0.88, 0.86))):
        ring = disc(radius, Paint(Material.PLAIN, rgb, part), 20)
        rings.append(move(ring, at(x, 0.0, 2.5, np.pi / 2)))
    return merge(rings)


def bollard(rng: np.random.Generator) -> TriangleSoup:
    """Return a knee-high post with a lighter head."""
    part = _part(rng)
    dark = Paint(Material.METAL, (0.25, 0.22, 0.20), part)
    light = Paint(Material.PLAIN, (0.80, 0.78, 0.72), part + 1)
    head = move(cylinder((0.08, 0.06), 0.14, light, 10), at(0.0, 0.0, 0.8))
    return merge([cylinder((0.07, 0.07), 0.82, dark, 10), head])


def advertising_pillar(rng: np.random.Generator) -> TriangleSoup:
    """Return a column covered with posters."""
    part = _part(rng)
    posters = Paint(Material.POSTER, _POSTERS[rng.integers(len(_POSTERS))], part)
    stone = Paint(Material.PLAIN, (0.40, 0.42, 0.40), part + 1)
    hat = move(cylinder((0.75, 0.05), 0.5, stone, 16), at(0.0, 0.0, 2.7))
    foot = cylinder((0.65, 0.65), 0.3, stone, 24)
    return merge([cylinder((0.6, 0.6), 2.7, posters, 24), foot, hat])


def bin_(rng: np.random.Generator) -> TriangleSoup:
    """Return a wheeled rubbish bin."""
    part = _part(rng)
    colours = [(0.20, 0.30, 0.22), (0.28, 0.28, 0.30), (0.45, 0.36, 0.18)]
    paint = Paint(Material.PLAIN, colours[rng.integers(3)], part)
    lid = Paint(Material.PLAIN, (0.18, 0.19, 0.20), part + 1)
    # Half a turn about x, as it narrows towards the base.
    flip = se3.make_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    bucket = move(frustum([-0.3, -0.3, -1.0], [0.3, 0.3, 0.0], (0.06, 0.06, 0.06), paint), flip)
    return merge([bucket, boxes([-0.33, -0.33, 1.0], [0.33, 0.33, 1.08], lid)])


SECTION_M: Final = 9.0


def picket_fence(rng: np.random.Generator) -> TriangleSoup:
    """Return upright boards with gaps nearly as wide as they are, on two rails between posts."""
    wood = Paint(Material.BARK, (0.42, 0.34, 0.26), _part(rng))
    height = float(rng.uniform(0.9, 1.3))
    boards = _row(float(rng.uniform(0.13, 0.17)), (0.08, 0.02, height), wood)
    return merge([boards, _rails((0.3, height - 0.25), 0.05, wood), _posts(3.0, height + 0.1)])


def railing(rng: np.random.Generator) -> TriangleSoup:
    """Return thin iron bars between two rails."""
    iron = Paint(Material.METAL, (0.16, 0.17, 0.17), _part(rng))
    return merge([_row(0.12, (0.02, 0.02, 1.05), iron), _rails((0.1, 1.0), 0.04, iron)])


def hedge(rng: np.random.Generator) -> TriangleSoup:
    """Return a row of bushes; between some of them one sees through."""
    parts = []
    for x in np.arange(0.5, SECTION_M, float(rng.uniform(0.8, 1.05))):
        leaves = Paint(Material.LEAVES, (0.26, 0.38, 0.16), _part(rng))
        ball = bumpy_ball((0.55, 0.45, 0.75), leaves, bump=0.35, wavelength=0.2)
        parts.append(move(ball, at(x, 0.0, 0.7)))
    return merge(parts)


def wires(rng: np.random.Generator) -> TriangleSoup:
    """Return five wires between posts."""
    steel = Paint(Material.METAL, (0.55, 0.56, 0.57), _part(rng))
    return merge([_rails(np.linspace(0.3, 1.5, 5), 0.02, steel), _posts(4.5, 1.6)])


def shop_window(rng: np.random.Generator) -> TriangleSoup:
    """Return the frame of a window and boards behind it; clear glass is not seen."""
    frame = Paint(Material.METAL, (0.30, 0.31, 0.32), _part(rng))
    parts = [_rails((0.4, 2.3), 0.07, frame), _row(1.5, (0.06, 0.06, 2.4), frame)]
    for x in np.arange(0.2, SECTION_M - 1.2, 1.3):
        board = Paint(Material.POSTER, _POSTERS[rng.integers(len(_POSTERS))], _part(rng))
        away = float(rng.uniform(0.5, 1.2))
        parts.append(boxes([x, away, 0.4], [x + 1.1, away + 0.05, rng.uniform(1.2, 2.2)], board))
    return merge(parts)


SECTIONS: Final = (picket_fence, railing, hedge, wires, shop_window)


def _row(step_m: float, size_m: tuple[float, float, float], paint: Paint) -> TriangleSoup:
    low = np.arange(0.0, SECTION_M, step_m)[:, None] * [1.0, 0.0, 0.0]
    return boxes(low, low + size_m, paint)


def _rails(heights_m: Iterable[float], thick_m: float, paint: Paint) -> TriangleSoup:
    low = np.array([[0.0, 0.02, height] for height in heights_m])
    return boxes(low, low + np.array([SECTION_M, thick_m, thick_m]), paint)


def _posts(step_m: float, height_m: float) -> TriangleSoup:
    return _row(step_m, (0.12, 0.12, height_m), Paint(Material.PLAIN, (0.60, 0.59, 0.56), 1))
