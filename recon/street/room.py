"""A furnished room, walked through with the rig in the hand: white walls, mirrors, windows.

Axes are those of a street: a lap begins at the origin along x, and goes round to the left. What is
in a mirror or beyond a window is seen by both cameras alike, but is not where the wall is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.geometry import se3
from recon.core.values.arrays import Float64
from recon.street.path import R_STREET_LEVEL, CentreLine, lap
from recon.street.props import draw_plan, house, wall_with_holes
from recon.street.settings import StreetScene
from recon.street.shapes import Material, Paint, TriangleSoup, at, boxes, merge, move, quads

_HEIGHT_M: Final = 2.7
_MARGIN_M: Final = 1.4  # between the path and the walls
_CORNER_M: Final = 1.0  # radius of the path in the corners
_OUTSIDE_M: Final = (12.0, 40.0)  # distance of the houses that the windows show
_WHITE: Final = Paint(Material.WHITE, (0.9, 0.89, 0.87))
_FRAME: Final = Paint(Material.PLAIN, (0.45, 0.36, 0.28), 5)
_GRASS: Final = Paint(Material.GRASS, (0.33, 0.38, 0.20), 6)
_WOODS: Final = [(0.55, 0.40, 0.26), (0.36, 0.24, 0.15), (0.72, 0.62, 0.48), (0.82, 0.80, 0.77)]
_PAPERS: Final = [
    Paint(Material.PLASTER, (0.62, 0.68, 0.60)),
    Paint(Material.BRICK, (0.64, 0.44, 0.36)),
    Paint(Material.POSTER, (0.66, 0.60, 0.52)),
]
#: What stands or hangs along the walls, in any order, as far as there is room.
_THINGS: Final = (
    "mirror", "mirror", "window", "window", "window", "door", "shelf", "shelf", "shelf", "table",
    "table", "picture", "picture", "picture", "sofa", "bare", "bare",
)  # fmt: skip
#: Of what a hand adds to the path: wavelength along it (m), and amplitudes (m, degrees).
_SHAKES: Final = ((0.7, 0.012, 0.6), (2.3, 0.04, 2.5))
_LOOK: Final = (5.3, 22.0)  # wavelength (m) and amplitude (degrees) of looking left and right


def room_lap(settings: StreetScene) -> CentreLine:
    """Return the lap through the room of a seed."""
    rng = np.random.default_rng([settings.seed, 70])
    return lap(float(rng.uniform(4.2, 5.4)), float(rng.uniform(3.0, 4.0)), _CORNER_M)


def hand_poses(settings: StreetScene, road: CentreLine) -> Float64:
    """Return ``T_street_camera`` (frames, 4, 4) of a left camera that is carried along."""
    rng = np.random.default_rng([settings.seed, 71])
    phases = rng.uniform(0.0, 2.0 * np.pi, (len(_SHAKES) + 1, 6))
    along = settings.speed_m_per_frame * np.arange(settings.frames)
    yaw, pitch, roll = np.radians([settings.yaw_deg, -settings.pitch_deg, settings.roll_deg])
    poses = []
    for s in along.tolist():
        off = np.zeros(6)
        for (wave_m, shift_m, turn_deg), phase in zip(_SHAKES, phases, strict=False):
            size = np.repeat([shift_m, math.radians(turn_deg)], 3)
            off += settings.sway * size * np.sin(2.0 * np.pi * s / wave_m + phase)
        look = math.radians(_LOOK[1]) * math.sin(2.0 * np.pi * s / _LOOK[0] + phases[-1, 0])
        T = road.place(s, 0.0, settings.camera_height_m)
        R = T[:3, :3] @ R_STREET_LEVEL
        for turn in ((0.0, yaw + look, 0.0), (pitch, 0.0, 0.0), (0.0, 0.0, roll), off[3:]):
            R = R @ se3.exp_so3(np.array(turn))
        poses.append(se3.make_transform(R, T[:3, 3] + off[:3]))
    return np.stack(poses)


def furnished_room(settings: StreetScene, road: CentreLine) -> TriangleSoup:
    """Return the room around a lap, its furniture, and what its windows show."""
    rng = np.random.default_rng([settings.seed, 72])
    low, high = road.xy_m.min(axis=0) - _MARGIN_M, road.xy_m.max(axis=0) + _MARGIN_M
    wide, deep = high - low
    floor = Paint(Material.PAVING, _WOODS[int(rng.integers(2))], 3)
    middle_x, middle_y = (0.5 * (low + high)).tolist()
    x, y = [wide, 0.0, 0.0], [0.0, deep, 0.0]
    island = _table(1.6, 0.9, rng)
    parts = [
        quads([*low, 0.0], x, y, floor),
        quads([*low, _HEIGHT_M], x, y, replace(_WHITE, part=4)),
        move(island, at(middle_x, middle_y, 0.0, float(rng.uniform(0.0, 3.0)))),
        quads([-80.0, -80.0, -3.0], [160.0, 0.0, 0.0], [0.0, 160.0, 0.0], _GRASS),
    ]
    things = list(rng.permutation(_THINGS))
    corners = ((high[0], high[1]), (low[0], high[1]), (low[0], low[1]), (high[0], low[1]))
    papered = rng.permutation([0, 0, 1, 1])  # two walls of four are white
    for side, corner in enumerate(corners):
        width = float(deep if side % 2 == 0 else wide)
        paint = _PAPERS[int(rng.integers(len(_PAPERS)))] if papered[side] else _WHITE
        soup = merge(_wall(width, replace(paint, part=10 + side), things, rng))
        parts.append(move(soup, at(*corner, 0.0, 0.5 * np.pi * (side - 1))))
    return merge(parts)


def _wall(
    width_m: float, paint: Paint, things: list[str], rng: np.random.Generator
) -> Iterator[TriangleSoup]:
    """Yield a wall with what is in front of it and beyond; axes: along it, outwards, up."""
    holes = []
    along = float(rng.uniform(0.1, 0.4))
    while things and along + 0.9 < width_m:
        room = min(float(rng.uniform(0.9, 1.9)), width_m - along - 0.05)
        thing = things.pop()
        if thing == "window":
            holes.append((along, 0.9, along + room, 2.2))
            yield _window(along, room)
            # A house at some distance from the window.
            width, away = float(rng.uniform(9.0, 14.0)), float(rng.uniform(*_OUTSIDE_M))
            aside = along + 0.5 * room - 0.5 * width + float(rng.uniform(-0.2, 0.2)) * away
            yield move(house(draw_plan(width, rng), rng), at(aside, away, -3.0))
        else:
            yield from (move(part, at(along, 0.0, 0.0)) for part in _standing(thing, room, rng))
        along += room + float(rng.uniform(0.05, 0.6))
    yield wall_with_holes(width_m, _HEIGHT_M, np.array(holes).reshape(-1, 4), paint)


def _standing(thing: str, width_m: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    """Yield something in front of a wall, from x = 0 on."""
    part = int(rng.integers(100, 2**30))
    if thing == "mirror":
        yield _framed(width_m, 0.35, 2.1, Paint(Material.MIRROR, (0.8, 0.8, 0.8), part))
    elif thing == "picture":
        low = float(rng.uniform(0.9, 1.3))
        colour = tuple(rng.uniform(0.3, 0.8, 3).tolist())
        yield _framed(0.8 * width_m, low, low + 0.7, Paint(Material.POSTER, colour, part))
    elif thing == "door":
        yield _framed(0.9, 0.02, 2.05, Paint(Material.DOOR, (0.5, 0.36, 0.24), part))
    elif thing == "shelf":
        yield from _shelf(width_m, rng)
    elif thing == "table":
        yield move(_table(width_m, 0.6, rng), at(0.5 * width_m, -0.35, 0.0))
    elif thing == "sofa":
        cloth = Paint(Material.PLAIN, tuple(rng.uniform(0.2, 0.6, 3).tolist()), part)
        feet = [
            [x, y, 0.1] for x, y in ((0, -0.85), (0, -0.25), (0, -0.85), (width_m - 0.2, -0.85))
        ]
        high = [[width_m, 0.0, 0.42], [width_m, 0.0, 0.85], [0.2, 0.0, 0.6], [width_m, 0.0, 0.6]]
        yield boxes(feet, high, cloth)


def _framed(width_m: float, low_m: float, high_m: float, paint: Paint) -> TriangleSoup:
    """Return a flat thing on the wall, in a wooden frame."""
    flat = quads([0.0, -0.02, low_m], [width_m, 0.0, 0.0], [0.0, 0.0, high_m - low_m], paint)
    return merge([flat, _bars(0.0, width_m, low_m, high_m, -0.05)])


def _window(along_m: float, width_m: float) -> TriangleSoup:
    """Return the frame of a window, which has no glass."""
    middle = along_m + 0.5 * width_m
    cross = boxes([middle - 0.03, 0.0, 0.9], [middle + 0.03, 0.06, 2.2], _FRAME)
    return merge([_bars(along_m, along_m + width_m, 0.9, 2.2, -0.04), cross])


def _bars(left: float, right: float, low: float, high: float, out: float) -> TriangleSoup:
    ends = np.array([
        [left, low, right, low + 0.05], [left, high - 0.05, right, high],
        [left, low, left + 0.05, high], [right - 0.05, low, right, high],
    ])  # fmt: skip
    near, far = np.full(4, out), np.full(4, 0.03)
    x0, z0, x1, z1 = ends.T
    return boxes(np.column_stack([x0, near, z0]), np.column_stack([x1, far, z1]), _FRAME)


def _table(width_m: float, depth_m: float, rng: np.random.Generator) -> TriangleSoup:
    """Return a table with things on it, around the origin."""
    x, y = 0.5 * width_m, 0.5 * depth_m
    wood = _wood(rng)
    feet = np.array([[sx * (x - 0.08), sy * (y - 0.08), 0.0] for sx in (-1, 1) for sy in (-1, 1)])
    parts = [
        boxes([-x, -y, 0.71], [x, y, 0.75], wood),
        boxes(feet - 0.03, feet + np.array([0.03, 0.03, 0.71]), wood),
    ]
    count = int(rng.integers(3, 7))
    place = rng.uniform([-0.9 * x, -0.8 * y], [0.7 * x, 0.6 * y], (count, 2))
    size = rng.uniform([0.08, 0.08, 0.02], [0.3, 0.2, 0.35], (count, 3))
    low = np.column_stack([place, np.full(count, 0.75)])
    return merge([*parts, _coloured(low, low + size, rng)])


def _shelf(width_m: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    depth, boards = 0.32, np.arange(0.05, 2.0, 0.38)
    low = [[0.0, -depth, z] for z in boards] + [[x, -depth, 0.0] for x in (0.0, width_m - 0.03)]
    high = [[width_m, 0.0, z + 0.03] for z in boards]
    high += [[x, 0.0, 2.0] for x in (0.03, width_m)]
    yield boxes(low, high, _wood(rng))
    for z in boards[:-1] + 0.03:
        wide = rng.uniform(0.02, 0.06, 60)
        left = 0.03 + np.cumsum(wide) - wide
        fits = (left + wide < width_m - 0.03) & (rng.random(60) < 0.9)
        if fits.any():
            tall, front = rng.uniform(0.18, 0.33, fits.sum()), rng.uniform(0.2, depth, fits.sum())
            base = np.column_stack([left[fits], -front, np.full(fits.sum(), z)])
            top = np.column_stack([left[fits] + wide[fits] - 0.002, 0.0 * front, z + tall])
            yield _coloured(base, top, rng)


def _coloured(low: Float64, high: Float64, rng: np.random.Generator) -> TriangleSoup:
    soup = boxes(low, high, Paint(Material.PLAIN))
    rgb, part = rng.uniform(0.1, 0.9, (len(low), 3)), rng.integers(1, 2**30, len(low))
    each = np.tile(np.repeat(np.arange(len(low)), 2), 6)  # side after side, of two triangles
    return replace(soup, rgb=rgb[each], part=part[each].astype(np.int32))


def _wood(rng: np.random.Generator) -> Paint:
    return Paint(Material.PLAIN, _WOODS[int(rng.integers(len(_WOODS)))], int(rng.integers(2**30)))
