"""Houses: a facade with recessed windows and doors, ledges, roof and blind walls.

Axes of a house: x along the facade from its left end (its right end as seen from the street),
y into the house, z up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from recon.core.values.arrays import Float64
from recon.street.shapes import Material, Paint, TriangleSoup, boxes, merge, painted, quads

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
    """Return a wall in the plane y = 0 with rectangular holes (N, 4), each (x0, z0, x1, z1).

    It is split along the edges of all holes.
    """
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
