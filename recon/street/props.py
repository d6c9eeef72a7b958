"""Objects in a street: parked cars, trees, lamp posts, signs, bollards, bins, fences and others.

Axes of an object: x along the street, y left, z up, its base at z = 0.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry import se3
from recon.core.values.arrays import Float64
from recon.street import shapes
from recon.street.shapes import (
    FAR_UV,
    Material,
    Paint,
    TriangleSoup,
    boxes,
    bumpy_ball,
    cylinder,
    disc,
    frustum,
    merge,
    move,
    quads,
)

_PAINTS = [
    (0.62, 0.63, 0.65), (0.12, 0.13, 0.15), (0.82, 0.82, 0.80), (0.55, 0.10, 0.10),
    (0.13, 0.22, 0.42), (0.34, 0.36, 0.38), (0.22, 0.34, 0.26), (0.72, 0.66, 0.48),
]  # fmt: skip
_POSTERS = [(0.62, 0.30, 0.22), (0.25, 0.42, 0.62), (0.66, 0.58, 0.25), (0.35, 0.52, 0.36)]


def car(rng: np.random.Generator) -> TriangleSoup:
    """Return a parked saloon, hatchback or van, facing along x."""
    part = int(rng.integers(1, 2**30))
    colour = _PAINTS[rng.integers(len(_PAINTS))]
    van = rng.random() < 0.18
    length = float(rng.uniform(4.6, 5.0) if van else rng.uniform(3.9, 4.5))
    height = float(rng.uniform(1.9, 2.05) if van else rng.uniform(1.42, 1.55))
    width = float(rng.uniform(1.72, 1.85))
    parts = [_body(length, width, Paint(Material.CAR_PAINT, colour, part), van)]
    parts += [_cabin(length, width, height, Paint(Material.CAR_GLASS, colour, part), van)]
    y = 0.5 * width
    parts += [_wheel(x, side, part) for x in (-0.3 * length, 0.31 * length) for side in (-y, y)]
    parts += _lamps(length, width, part)
    return merge(parts)


def _body(length: float, width: float, paint: Paint, van: bool) -> TriangleSoup:
    a = length / 2
    boot = [(-a + 0.06, 0.92)] if van else [(-a + 0.55, 0.97), (-a + 0.08, 0.9)]
    profile = [(-a + 0.05, 0.24), (a - 0.1, 0.2), (a, 0.36), (a - 0.03, 0.62), (a - 0.25, 0.76)]
    profile += [(a - 1.05, 0.93), (0.0, 0.97), *boot, (-a, 0.6)]
    return shapes.extrusion(profile, width, paint)


def _cabin(length: float, width: float, height: float, paint: Paint, van: bool) -> TriangleSoup:
    a, side, front = length / 2, 0.14, 0.75
    back = 0.12 if van else 0.4
    low = np.array([-a + (0.06 if van else 0.35), -width / 2 + 0.03, 0.9])
    high = np.array([a - 1.0, width / 2 - 0.03, height])
    panes = frustum(low, high, (back, front, side), paint)
    corner = np.array([low[0] + back, low[1] + side, height])
    roof = Paint(Material.CAR_PAINT, paint.rgb, paint.part)
    size = high - low - np.array([back + front, 2 * side, 0.0])
    return merge([panes, quads(corner, [size[0], 0, 0], [0, size[1], 0], roof, FAR_UV)])


def _wheel(x: float, y: float, part: int) -> TriangleSoup:
    tyre = Paint(Material.PLAIN, (0.11, 0.11, 0.12), part + 1)
    rim = Paint(Material.METAL, (0.55, 0.56, 0.58), part + 2)
    # The tyre protrudes 1 cm from the body, the rim 1 cm from the tyre.
    out = float(np.sign(y))
    lie = se3.exp_so3(np.array([out * np.pi / 2, 0.0, 0.0]))
    outer = move(disc(0.31, tyre), _at(x, y + 0.01 * out, 0.31))
    inner = move(disc(0.19, rim), _at(x, y + 0.02 * out, 0.31))
    at = np.array([x, y + 0.01 * out, 0.31])
    tread = move(cylinder((0.31, 0.31), 0.2, tyre, 14), se3.make_transform(lie, at))
    return merge([outer, inner, tread])


def _lamps(length: float, width: float, part: int) -> list[TriangleSoup]:
    white = Paint(Material.PLAIN, (0.85, 0.85, 0.80), part + 3)
    red = Paint(Material.PLAIN, (0.55, 0.06, 0.05), part + 4)
    plate = Paint(Material.POSTER, (0.80, 0.80, 0.72), part + 5)
    lamps = []
    for sign, paint in ((1.0, white), (-1.0, red)):
        x = sign * (length / 2 + 0.01)
        lows = [[x, -width / 2 + 0.05, 0.56], [x, width / 2 - 0.45, 0.56]]
        lamps.append(quads(lows, [0, 0.4, 0], [0, 0, 0.16], paint))
        lamps.append(quads([x, -0.26, 0.38], [0, 0.52, 0], [0, 0, 0.12], plate))
    return lamps


def tree(rng: np.random.Generator) -> TriangleSoup:
    """Return a tree: a trunk and a crown of several bumpy balls."""
    part = int(rng.integers(1, 2**30))
    height = float(rng.uniform(2.1, 2.9))
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
        ball = shapes.bumpy_ball(radii, leaves, bump=0.22, wavelength=0.28, seed=part + k)
        parts.append(move(ball, _at(away[0], away[1], away[2] + height)))
    return merge(parts)


def lamp_post(side: float, rng: np.random.Generator) -> TriangleSoup:
    """Return a 6 m post with an arm over the road, which is towards ``-side``."""
    paint = Paint(Material.METAL, (0.30, 0.33, 0.32), int(rng.integers(1, 2**30)))
    arm = boxes([-0.04, min(0.0, -side * 1.4), 5.9], [0.04, max(0.0, -side * 1.4), 5.98], paint)
    y0, y1 = sorted((-side * 1.0, -side * 1.6))
    lamp = boxes([-0.14, y0, 5.8], [0.14, y1, 5.92], paint)
    base = cylinder((0.13, 0.11), 0.9, paint, 12)
    return merge([base, cylinder((0.08, 0.05), 6.0, paint, 10), arm, lamp])


def sign(rng: np.random.Generator) -> TriangleSoup:
    """Return a round or square traffic sign on a thin pole, facing backwards along x."""
    part = int(rng.integers(1, 2**30))
    pole = cylinder((0.035, 0.035), 2.9, Paint(Material.METAL, (0.55, 0.56, 0.57), part), 8)
    if rng.random() < 0.5:
        blue = Paint(Material.POSTER, (0.16, 0.30, 0.62), part)
        return merge([pole, boxes([-0.08, -0.3, 2.2], [-0.045, 0.3, 2.85], blue)])
    turn = se3.exp_so3(np.array([0, 0, np.pi / 2]))
    rings = [pole]
    for x, radius, rgb in ((-0.05, 0.33, (0.70, 0.10, 0.10)), (-0.055, 0.23, (0.88, 0.88, 0.86))):
        ring = disc(radius, Paint(Material.PLAIN, rgb, part), 20)
        rings.append(move(ring, se3.make_transform(turn, np.array([x, 0.0, 2.5]))))
    return merge(rings)


def bollard(rng: np.random.Generator) -> TriangleSoup:
    """Return a knee-high post with a lighter head."""
    part = int(rng.integers(1, 2**30))
    dark = Paint(Material.METAL, (0.25, 0.22, 0.20), part)
    light = Paint(Material.PLAIN, (0.80, 0.78, 0.72), part + 1)
    head = move(cylinder((0.08, 0.06), 0.14, light, 10), _at(0.0, 0.0, 0.8))
    return merge([cylinder((0.07, 0.07), 0.82, dark, 10), head])


def advertising_pillar(rng: np.random.Generator) -> TriangleSoup:
    """Return a column covered with posters."""
    part = int(rng.integers(1, 2**30))
    posters = Paint(Material.POSTER, _POSTERS[rng.integers(len(_POSTERS))], part)
    stone = Paint(Material.PLAIN, (0.40, 0.42, 0.40), part + 1)
    hat = move(cylinder((0.75, 0.05), 0.5, stone, 16), _at(0.0, 0.0, 2.7))
    foot = cylinder((0.65, 0.65), 0.3, stone, 24)
    return merge([cylinder((0.6, 0.6), 2.7, posters, 24), foot, hat])


def bin_(rng: np.random.Generator) -> TriangleSoup:
    """Return a wheeled rubbish bin."""
    part = int(rng.integers(1, 2**30))
    colours = [(0.20, 0.30, 0.22), (0.28, 0.28, 0.30), (0.45, 0.36, 0.18)]
    paint = Paint(Material.PLAIN, colours[rng.integers(3)], part)
    lid = Paint(Material.PLAIN, (0.18, 0.19, 0.20), part + 1)
    # Half a turn about x, as it narrows towards the base.
    flip = se3.make_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    bucket = move(frustum([-0.3, -0.3, -1.0], [0.3, 0.3, 0.0], (0.06, 0.06, 0.06), paint), flip)
    return merge([bucket, boxes([-0.33, -0.33, 1.0], [0.33, 0.33, 1.08], lid)])


def _at(x: float, y: float, z: float) -> Float64:
    return se3.make_transform(np.eye(3), np.array([x, y, z]))


SECTION_M: Final = 9.0


def picket_fence(rng: np.random.Generator) -> TriangleSoup:
    """Return upright boards with gaps nearly as wide as they are, on two rails between posts."""
    wood = Paint(Material.BARK, (0.42, 0.34, 0.26), int(rng.integers(1, 2**30)))
    height = float(rng.uniform(0.9, 1.3))
    boards = _row(float(rng.uniform(0.13, 0.17)), (0.08, 0.02, height), wood)
    return merge([boards, _rails((0.3, height - 0.25), 0.05, wood), _posts(3.0, height + 0.1)])


def railing(rng: np.random.Generator) -> TriangleSoup:
    """Return thin iron bars between two rails."""
    iron = Paint(Material.METAL, (0.16, 0.17, 0.17), int(rng.integers(1, 2**30)))
    return merge([_row(0.12, (0.02, 0.02, 1.05), iron), _rails((0.1, 1.0), 0.04, iron)])


def hedge(rng: np.random.Generator) -> TriangleSoup:
    """Return a row of bushes; between some of them one sees through."""
    parts = []
    for x in np.arange(0.5, SECTION_M, float(rng.uniform(0.8, 1.05))):
        leaves = Paint(Material.LEAVES, (0.26, 0.38, 0.16), int(rng.integers(1, 2**30)))
        ball = bumpy_ball((0.55, 0.45, 0.75), leaves, bump=0.35, wavelength=0.2, seed=leaves.part)
        parts.append(move(ball, se3.make_transform(np.eye(3), np.array([x, 0.0, 0.7]))))
    return merge(parts)


def wires(rng: np.random.Generator) -> TriangleSoup:
    """Return five wires between posts."""
    steel = Paint(Material.METAL, (0.55, 0.56, 0.57), int(rng.integers(1, 2**30)))
    return merge([_rails(tuple(np.linspace(0.3, 1.5, 5)), 0.02, steel), _posts(4.5, 1.6)])


def shop_window(rng: np.random.Generator) -> TriangleSoup:
    """Return the frame of a window and boards behind it; clear glass is not seen."""
    frame = Paint(Material.METAL, (0.30, 0.31, 0.32), int(rng.integers(1, 2**30)))
    parts = [_rails((0.4, 2.3), 0.07, frame), _row(1.5, (0.06, 0.06, 2.4), frame)]
    for x in np.arange(0.2, SECTION_M - 1.2, 1.3):
        colour = _POSTERS[rng.integers(len(_POSTERS))]
        board = Paint(Material.POSTER, colour, int(rng.integers(1, 2**30)))
        away = float(rng.uniform(0.5, 1.2))
        parts.append(boxes([x, away, 0.4], [x + 1.1, away + 0.05, rng.uniform(1.2, 2.2)], board))
    return merge(parts)


SECTIONS: Final = (picket_fence, railing, hedge, wires, shop_window)


def _row(step_m: float, size_m: tuple[float, float, float], paint: Paint) -> TriangleSoup:
    x = np.arange(0.0, SECTION_M, step_m)
    low = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    return boxes(low, low + size_m, paint)


def _rails(heights_m: tuple[float, ...], thick_m: float, paint: Paint) -> TriangleSoup:
    low = np.array([[0.0, 0.02, height] for height in heights_m])
    return boxes(low, low + np.array([SECTION_M, thick_m, thick_m]), paint)


def _posts(step_m: float, height_m: float) -> TriangleSoup:
    grey = Paint(Material.PLAIN, (0.60, 0.59, 0.56), 1)
    return _row(step_m, (0.12, 0.12, height_m), grey)
