"""What stands in a street: houses, parked cars, trees, lamp posts, signs, fences and others.

Axes of an object: x along the street, y left, z up, its base at z = 0. Axes of a house: x along
the facade from its left end (its right end as seen from the street), y into the house, z up.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from recon.core.geometry import se3
from recon.core.values.arrays import Float64
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
    painted,
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


_REVEAL_M: Final = 0.18  # depth of the windows in the wall
_OVERLAP_M: Final = 5e-4  # overlap of pieces of wall, so that no ray passes between them
_FRAME_M: Final = 0.07

_PLASTERS = [
    (0.80, 0.74, 0.62), (0.72, 0.66, 0.60), (0.82, 0.80, 0.76), (0.77, 0.62, 0.47),
    (0.66, 0.70, 0.68), (0.80, 0.70, 0.66), (0.70, 0.58, 0.50),
]  # fmt: skip
_BRICKS = [(0.58, 0.33, 0.26), (0.64, 0.44, 0.33), (0.50, 0.32, 0.28), (0.66, 0.55, 0.42)]
_ROOFS = [(0.48, 0.26, 0.20), (0.30, 0.30, 0.32), (0.40, 0.28, 0.24)]
_DOORS = [(0.30, 0.18, 0.12), (0.16, 0.26, 0.22), (0.36, 0.12, 0.12), (0.20, 0.24, 0.34)]
_TRIM = [(0.84, 0.82, 0.78), (0.62, 0.58, 0.52), (0.45, 0.42, 0.40)]


@dataclass(frozen=True)
class HousePlan:
    """Dimensions (metres) and colours of one house."""

    width: float
    depth: float
    floors: int
    storey: float
    window: tuple[float, float]
    sill: float
    pitched: bool  # a gable roof rather than a parapet
    wall: Paint
    trim: Paint
    door: Paint
    roof: Paint

    @property
    def eaves(self) -> float:
        """Height of the walls."""
        return self.floors * self.storey + 0.4


def draw_plan(width: float, rng: np.random.Generator) -> HousePlan:
    """Return a random house of a given width."""
    brick = rng.random() < 0.4
    colours = _BRICKS if brick else _PLASTERS
    base = np.clip(np.array(colours[rng.integers(len(colours))]) + rng.normal(0, 0.03, 3), 0, 1)
    part = int(rng.integers(1, 2**30))
    return HousePlan(
        width=width,
        depth=float(rng.uniform(8.0, 11.0)),
        floors=int(rng.integers(2, 5)),
        storey=float(rng.uniform(2.8, 3.3)),
        window=(float(rng.uniform(0.95, 1.4)), float(rng.uniform(1.35, 1.7))),
        sill=float(rng.uniform(0.75, 0.95)),
        pitched=bool(rng.random() < 0.6),
        wall=Paint(Material.BRICK if brick else Material.PLASTER, tuple(base.tolist()), part),
        trim=Paint(Material.PLAIN, _TRIM[rng.integers(len(_TRIM))], part + 1),
        door=Paint(Material.DOOR, _DOORS[rng.integers(len(_DOORS))], part + 2),
        roof=Paint(Material.ROOF, _ROOFS[rng.integers(len(_ROOFS))], part + 3),
    )


def house(plan: HousePlan, rng: np.random.Generator) -> TriangleSoup:
    """Build a house, in the axes described above."""
    holes, door = _openings(plan, rng)
    every = np.vstack([holes, door])
    x0, z0, x1, z1 = door.T
    leaf = _upright(np.column_stack([x0, z0, x1 - x0, z1 - z0]), _REVEAL_M, plan.door)
    facade = wall_with_holes(plan.width, plan.eaves, every, plan.wall)
    parts = [facade, leaf, _windows(holes, rng)]
    w, d, h = plan.width, plan.depth, plan.eaves
    feet, along = [[0, 0, 0], [w, 0, 0], [0, d, 0]], [[0, d, 0], [0, d, 0], [w, 0, 0]]
    blind_walls = quads(feet, along, [0, 0, h], plan.wall)
    parts += [_reveals(every, plan.trim), _ledges(plan, holes), blind_walls]
    if plan.pitched:
        parts.append(_gable(plan))
    else:
        flat = quads([0, 0, h], [w, 0, 0], [0, d, 0], plan.trim)
        parts += [flat, boxes([0, 0.02, h], [w, 0.25, h + 0.7], plan.wall)]
    x = 0.15 if rng.random() < 0.5 else w - 0.25
    zinc = Paint(Material.METAL, (0.42, 0.43, 0.44), int(rng.integers(2**30)))
    return merge([*parts, boxes([x, -0.1, 0.0], [x + 0.1, -0.01, h], zinc)])


def _openings(plan: HousePlan, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Return windows (N, 4) and the door (1, 4), each as (x0, z0, x1, z1)."""
    columns = max(2, int(plan.width / rng.uniform(2.2, 3.0)))
    centres = (np.arange(columns) + 0.5) * plan.width / columns
    w, h = plan.window
    entrance = int(rng.integers(columns))
    holes = []
    for floor in range(plan.floors):
        low = 0.4 + floor * plan.storey + plan.sill - 0.4 * (floor == 0)
        holes += [
            (x - w / 2, low, x + w / 2, low + h)
            for k, x in enumerate(centres)
            if floor > 0 or k != entrance
        ]
    x = centres[entrance]
    return np.array(holes), np.array([[x - 0.55, 0.05, x + 0.55, 2.3]])


def wall_with_holes(width_m: float, height_m: float, holes: Float64, paint: Paint) -> TriangleSoup:
    """Return a wall in the plane y = 0 with rectangular holes (N, 4), each (x0, z0, x1, z1)."""
    xs = np.unique(np.concatenate([[0.0, width_m], holes[:, 0], holes[:, 2]]))
    zs = np.unique(np.concatenate([[0.0, height_m], holes[:, 1], holes[:, 3]]))
    x_mid, z_mid = 0.5 * (xs[:-1] + xs[1:]), 0.5 * (zs[:-1] + zs[1:])
    gx, gz = np.meshgrid(np.arange(len(x_mid)), np.arange(len(z_mid)), indexing="ij")
    px, pz = x_mid[gx][..., None], z_mid[gz][..., None]
    in_x = (px > holes[:, 0]) & (px < holes[:, 2])
    in_hole = (in_x & (pz > holes[:, 1]) & (pz < holes[:, 3])).any(axis=-1)
    column, row = gx[~in_hole], gz[~in_hole]
    low = np.column_stack([xs[column], zs[row]]) - _OVERLAP_M
    high = np.column_stack([xs[column + 1], zs[row + 1]]) + _OVERLAP_M
    return _upright(np.column_stack([low, high - low]), 0.0, paint, low)


def _windows(holes: Float64, rng: np.random.Generator) -> TriangleSoup:
    parts = rng.integers(1, 2**30, len(holes))
    x0, z0, x1, z1 = holes.T
    w, h, f = x1 - x0, z1 - z0, np.full(len(holes), _FRAME_M)
    # Left end, lower end, width and height of the six bars of each window.
    bars = np.array([
        [x0, z0, w, f], [x0, z1 - f, w, f], [x0, z0, f, h], [x1 - f, z0, f, h],
        [x0 + w / 2 - f / 2, z0, f, h], [x0, z0 + 0.68 * h, w, f],
    ])  # fmt: skip
    bars = bars.transpose(2, 0, 1).reshape(-1, 4)
    glass = Paint(Material.GLASS, (0.22, 0.25, 0.29))
    wood = Paint(Material.PLAIN, (0.86, 0.85, 0.82))
    panes = np.column_stack([x0, z0, w, h])
    soup = merge([_upright(panes, _REVEAL_M, glass), _upright(bars, _REVEAL_M - 0.03, wood)])
    part = np.concatenate([np.repeat(parts, 2), np.repeat(parts, 12)])
    return replace(soup, part=part.astype(np.int32))


def _upright(
    rectangles: Float64, y: float, paint: Paint, uv_origins: Any = (0.0, 0.0)
) -> TriangleSoup:
    """Return rectangles (N, 4) of x, z, width and height, parallel to the facade."""
    x, z, width, height = rectangles.T
    zero = np.zeros(len(x))
    along, up = np.column_stack([width, zero, zero]), np.column_stack([zero, zero, height])
    return quads(np.column_stack([x, zero + y, z]), along, up, paint, uv_origins)


def _reveals(holes: Float64, paint: Paint) -> TriangleSoup:
    x0, z0, x1, z1 = holes.T
    zero = np.zeros(len(holes))
    low, high, right = (np.column_stack([x, zero, z]) for x, z in ((x0, z0), (x0, z1), (x1, z0)))
    along, up = np.column_stack([x1 - x0, zero, zero]), np.column_stack([zero, zero, z1 - z0])
    sides = [(low, along), (high, along), (low, up), (right, up)]
    return merge([quads(p, e, [0.0, _REVEAL_M, 0.0], paint) for p, e in sides])


def _ledges(plan: HousePlan, holes: Float64) -> TriangleSoup:
    w = plan.width
    levels = 0.4 + plan.storey * np.arange(1, plan.floors)
    bands = [(plan.eaves - 0.25, plan.eaves + 0.1, 0.3)]
    bands += [(z - 0.08, z + 0.08, 0.08) for z in levels]
    low = np.array([[0.0, -out, z0] for z0, _, out in bands])
    high = np.array([[w, 0.02, z1] for _, z1, _ in bands])
    x0, z0, x1, _ = holes.T
    flat = np.full(len(holes), 0.02)
    under = np.column_stack([x0 - 0.08, flat - 0.14, z0 - 0.07])
    sills = boxes(under, np.column_stack([x1 + 0.08, flat, z0]), plan.trim)
    return merge([boxes(low, high, plan.trim), sills])


def _gable(plan: HousePlan) -> TriangleSoup:
    w, d, h, out = plan.width, plan.depth, plan.eaves + 0.05, 0.35
    rise = 0.42 * d
    slope = rise / (d / 2)
    foot, climb = h - out * slope, rise + out * slope
    front = quads([0, -out, foot], [w, 0, 0], [0, d / 2 + out, climb], plan.roof)
    back = quads([0, d + out, foot], [w, 0, 0], [0, -d / 2 - out, climb], plan.roof)
    corners = np.array([[[x, 0, h], [x, d, h], [x, d / 2, h + rise]] for x in (0.0, w)])
    return merge([front, back, painted(corners, corners[..., 1:].copy(), plan.wall)])
