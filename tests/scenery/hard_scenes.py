"""Scenes on which stereo matching is hard: sky, plain walls, wires, glass, dark, and many steps.

Axes: x ahead of the camera, y left, z up; the ground is z = 0.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from recon.core.geometry import se3
from recon.core.values.arrays import Float64
from recon.street import props
from recon.street.kernels.surface import value_noise
from recon.street.path import R_STREET_LEVEL
from recon.street.props import draw_plan, house, wall_with_holes
from recon.street.shapes import (
    Material,
    Paint,
    TriangleSoup,
    at,
    band,
    boxes,
    bumpy_ball,
    cylinder,
    merge,
    move,
    painted,
    quads,
)


@dataclass(frozen=True, eq=False)
class HardScene:
    """Triangles, how they are lit, and from where they are seen."""

    soup: TriangleSoup
    T_scene_left: Float64  # (4, 4), the left camera
    baseline_m: float
    to_sun: Float64  # (3,), unit vector
    lamps: tuple[tuple[float, float, float, float], ...] = ()  # x, y, z, strength, instead of sun
    cone_rad: float | None = None  # of lamps that shine where the camera looks
    panes: TriangleSoup | None = None  # glass, in which one sees what is before and behind it
    clear: bool = False  # a sky without clouds, and with the glow of the sun


def hard_scene(name: str, seed: int) -> HardScene:
    """Lay out one of `HARD_SCENES`."""
    return HARD_SCENES[name](np.random.default_rng([seed, *name.encode()]))


def _looking(xyz: tuple[float, float, float], yaw_deg: float, pitch_deg: float) -> Float64:
    """Return the pose of a camera that is turned to the left, then downwards."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    R = R_STREET_LEVEL @ se3.exp_so3(np.array([0.0, -yaw, 0.0]))
    return se3.make_transform(R @ se3.exp_so3(np.array([-pitch, 0.0, 0.0])), np.array(xyz))


def _sun(azimuth_deg: float, climb_deg: float) -> Float64:
    a, c = np.radians([azimuth_deg, climb_deg])
    return np.array([np.cos(c) * np.cos(a), np.cos(c) * np.sin(a), np.sin(c)])


def _ground(paint: Paint, size_m: float = 150.0) -> TriangleSoup:
    return quads([-size_m, -size_m, 0.0], [2 * size_m, 0, 0], [0, 2 * size_m, 0], paint)


def _part(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 2**30))


def _rod(start: Float64, end: Float64, radius_m: float, paint: Paint) -> TriangleSoup:
    """Return a thin prism between two points."""
    along = end - start
    side = np.cross(along, [0.31, 0.17, 0.93])
    side *= radius_m / np.linalg.norm(side)
    other = np.cross(along, side) / np.linalg.norm(along)
    ring = [side, other, -side, -other, side]
    corners = band(np.array([start + k for k in ring]), np.array([end + k for k in ring]))
    return painted(corners, corners[..., [0, 2]], paint)


def _yard(rng: np.random.Generator) -> HardScene:
    """A walled yard against the sun: bare and leafy trees, a house, the sky between branches."""
    wall = Paint(Material.PLASTER, (0.78, 0.74, 0.68), _part(rng))
    away, left = float(rng.uniform(11.0, 15.0)), float(rng.uniform(4.0, 5.5))
    stone = Paint(Material.PAVING, (0.50, 0.48, 0.44), _part(rng))
    plan = draw_plan(9.0, rng)
    parts = [
        _ground(Paint(Material.GRASS, (0.36, 0.40, 0.22), _part(rng))),
        quads([0.0, -1.2, 0.01], [away, 0.6, 0], [0, 1.6, 0], stone),
        boxes([away, -30.0, 0.0], [away + 0.3, 30.0, 2.6], wall),
        boxes([-2.0, left, 0.0], [away, left + 0.25, 2.3], replace(wall, part=wall.part + 1)),
        move(house(plan, rng), at(away + 8.0, -2.0, 0.0, -0.5 * np.pi + 0.1)),
        move(props.tree(rng), at(float(rng.uniform(7.0, 9.0)), left - 1.3, 0.0)),
        *_bare_tree(np.array([float(rng.uniform(4.5, 6.0)), -1.6, 0.0]), rng),
        *_bare_tree(np.array([float(rng.uniform(8.0, 10.0)), 0.8, 0.0]), rng),
        move(props.bin_(rng), at(3.4, float(rng.uniform(1.0, 1.6)), 0.0, 0.3)),
    ]
    pose = _looking((0.0, 0.0, 1.6), float(rng.uniform(-3, 3)), -13.0)
    return HardScene(merge(parts), pose, 0.25, _sun(float(rng.uniform(-24, -12)), 24.0), clear=True)


def _bare_tree(foot: Float64, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    """Yield a trunk and branches that fork, with few leaves."""
    bark = Paint(Material.BARK, (0.30, 0.25, 0.21), _part(rng))
    open_ = [(foot, np.array([0.05, 0.05, 1.7]), 0.10)]
    while open_:
        start, along, radius = open_.pop()
        yield _rod(start, start + along, radius, bark)
        if radius < 0.008:
            if rng.random() < 0.25:
                leaves = Paint(Material.LEAVES, (0.36, 0.38, 0.18), _part(rng))
                ball = bumpy_ball(rng.uniform(0.05, 0.14, 3), leaves, bump=0.3, wavelength=0.5)
                yield move(ball, at(*(start + along)))
            continue
        for _ in range(3 if radius > 0.04 else 2):
            length = float(np.linalg.norm(along)) * rng.uniform(0.6, 0.85)
            way = along / np.linalg.norm(along) + rng.normal(0.0, 0.5, 3)
            open_.append((start + along, length * way / np.linalg.norm(way), 0.58 * radius))


def _corner(rng: np.random.Generator) -> HardScene:
    """Two white walls with few marks, and a plain table top with an object or two."""
    white = Paint(Material.WHITE, (0.86, 0.85, 0.82), _part(rng))
    wood = Paint(Material.WHITE, (0.62, 0.47, 0.33), _part(rng))
    away, left = float(rng.uniform(2.6, 3.2)), float(rng.uniform(0.9, 1.4))
    near, wide = 0.75, float(rng.uniform(1.1, 1.4))
    metal = Paint(Material.METAL, (0.55, 0.56, 0.57), _part(rng))
    things = [
        move(_vase(rng), at(1.35 + 0.2 * rng.random(), rng.uniform(-0.4, 0.3), 0.75)),
        boxes(
            [1.15, -0.45, 0.75], [1.30, -0.25, 0.80], Paint(Material.POSTER, (0.6, 0.3, 0.25), 7)
        ),
    ]
    parts = [
        _ground(Paint(Material.WHITE, (0.5, 0.47, 0.44), _part(rng)), 4.0),
        quads([away, -4.0, 0.0], [0, 4.0 + left, 0], [0, 0, 2.7], white),
        quads([-1.0, left, 0.0], [away + 1.0, 0, 0], [0, 0, 2.7], replace(white, part=9)),
        boxes([near, -0.9, 0.71], [near + 1.0, -0.9 + wide, 0.75], wood),
        boxes([away - 0.012, -1.0, 0.28], [away, -0.92, 0.36], replace(white, part=11)),
        boxes([away - 0.02, -4.0, 0.0], [away, left, 0.09], replace(white, part=12)),
        boxes([away - 0.01, 0.2, 1.55], [away, 0.206, 1.556], metal),
        *things[: 1 + int(rng.integers(2))],
    ]
    pose = _looking((0.0, 0.0, 1.35), float(rng.uniform(4, 12)), 17.0)
    lamps = ((0.4, -1.8, 2.4, 3.4), (1.8, 0.2, 2.5, 1.2))
    return HardScene(merge(parts), pose, 0.12, _sun(0, 80), lamps)


def _vase(rng: np.random.Generator) -> TriangleSoup:
    glaze = Paint(Material.PLAIN, tuple(rng.uniform(0.2, 0.7, 3).tolist()), _part(rng))
    radii = (0.04, 0.075, 0.08, 0.05, 0.035)
    rings = [
        move(cylinder((a, b), 0.06, glaze, 24), at(0.0, 0.0, 0.06 * k))
        for k, (a, b) in enumerate(pairwise(radii))
    ]
    return merge(rings)


def _wires(rng: np.random.Generator) -> HardScene:
    """Wires across the sky, poles and a wire fence, before houses and trees far away."""
    steel = Paint(Material.METAL, (0.42, 0.43, 0.44), _part(rng))
    cable = Paint(Material.PLAIN, (0.10, 0.10, 0.11), _part(rng))
    parts = [_ground(Paint(Material.GRASS, (0.36, 0.38, 0.22), _part(rng)))]
    for k in range(6):
        far = at(float(rng.uniform(45, 60)), 42.0 - 15.0 * k, 0.0, -0.5 * np.pi)
        parts.append(move(house(draw_plan(float(rng.uniform(9, 13)), rng), rng), far))
    for _ in range(5):
        spot = at(float(rng.uniform(26, 40)), float(rng.uniform(-22, 22)), 0.0)
        parts.append(move(props.tree(rng), spot))
    for x, y in ((5.0, 1.3), (7.5, -1.7), (11.0, 2.8), (16.0, -2.2)):
        pole = cylinder((0.035, 0.03), float(rng.uniform(4.0, 6.0)), steel, 10)
        parts.append(move(pole, at(x, y + float(rng.uniform(-0.3, 0.3)), 0.0)))
    for z in np.linspace(3.2, 4.6, 5) + rng.uniform(-0.1, 0.1, 5):
        x, sag, lean = float(rng.uniform(6.0, 11.0)), float(rng.uniform(0.2, 0.6)), rng.normal(0, 3)
        across = np.linspace(-1.0, 1.0, 25)
        line = np.column_stack([x + lean * across, 14.0 * across, z - sag * (1 - across**2)])
        parts += [_rod(a, b, 0.007, cable) for a, b in pairwise(line)]
    parts += _mesh_fence(float(rng.uniform(3.0, 4.0)), float(rng.uniform(0.25, 0.45)), rng)
    pose = _looking((0.0, 0.0, 1.5), float(rng.uniform(-4, 4)), -7.0)
    return HardScene(merge(parts), pose, 0.2, _sun(120, 40))


def _mesh_fence(away_m: float, slope: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    """Yield a fence of diagonal wires and posts that recedes to the left."""
    zinc = Paint(Material.METAL, (0.50, 0.52, 0.52), _part(rng))

    def place(y: float, z: float) -> Float64:
        return np.array([away_m + slope * (y + 3.0), y, z])

    for y in np.arange(-4.0, 4.0, 0.14):
        for way in (-1.0, 1.0):
            yield _rod(place(y, 0.05), place(y + 1.15 * way, 1.2), 0.0025, zinc)
    for y in np.arange(-4.0, 4.5, 2.0):
        yield move(cylinder((0.025, 0.025), 1.35, zinc, 10), at(*place(y, 0.0)))
    yield _rod(place(-5.0, 1.2), place(5.0, 1.2), 0.012, zinc)


def _glass(rng: np.random.Generator) -> HardScene:
    """A shop front whose panes show what is behind and before them, and a mirror on the wall."""
    brick = Paint(Material.BRICK, (0.60, 0.40, 0.32), _part(rng))
    frame = Paint(Material.METAL, (0.25, 0.26, 0.27), _part(rng))
    away, mid = float(rng.uniform(3.4, 4.2)), float(rng.uniform(-0.2, 0.4))
    hole = (2.0 + mid, 0.5, 5.6 + mid, 2.5)
    front = wall_with_holes(9.0, 3.4, np.array([hole, (6.2 + mid, 0.6, 7.1 + mid, 2.2)]), brick)
    # The wall runs along x from 0; seen from the street its left end is on the right.
    T = at(away, 4.5, 0.0, -0.5 * np.pi)
    width, height = hole[2] - hole[0], hole[3] - hole[1]
    mirror = Paint(Material.MIRROR, (0.8, 0.8, 0.8), _part(rng))
    glass = replace(mirror, part=mirror.part + 1)
    bars = [
        boxes([x - 0.03, -0.03, hole[1]], [x + 0.03, 0.05, hole[3]], frame)
        for x in (hole[0], hole[0] + 0.5 * width, hole[2])
    ]
    parts = [
        _ground(Paint(Material.PAVING, (0.56, 0.54, 0.51), _part(rng)), 60.0),
        move(merge([front, *bars, *_goods(hole, rng)]), T),
        move(quads([6.2 + mid, 0.04, 0.6], [0.9, 0, 0], [0, 0, 1.6], mirror), T),
        move(house(draw_plan(14.0, rng), rng), at(-9.0, -7.0, 0.0, 0.5 * np.pi)),
        move(props.tree(rng), at(-4.5, float(rng.uniform(-1.0, 2.0)), 0.0)),
        move(props.car(rng), at(-3.0, -2.5, 0.0, 0.5 * np.pi)),
        move(props.bollard(rng), at(2.4, -0.9, 0.0)),
    ]
    panes = move(quads([hole[0], 0.0, hole[1]], [width, 0, 0], [0, 0, height], glass), T)
    pose = _looking((0.0, 0.0, 1.55), float(rng.uniform(-5, 5)), 1.0)
    return HardScene(merge(parts), pose, 0.14, _sun(160, 42), panes=panes)


def _goods(
    hole: tuple[float, float, float, float], rng: np.random.Generator
) -> Iterator[TriangleSoup]:
    """Yield what stands behind a pane, and the room around it; axes of the wall."""
    dim = Paint(Material.WHITE, (0.55, 0.52, 0.48), _part(rng))
    x0, z0, x1, _ = hole
    yield boxes([x0 - 0.6, 0.1, z0 - 0.1], [x1 + 0.6, 2.6, z0 - 0.02], dim)
    yield quads([x0 - 0.6, 2.6, z0], [x1 - x0 + 1.2, 0, 0], [0, 0, 2.4], replace(dim, part=3))
    for x in np.arange(x0 + 0.2, x1 - 0.4, 0.55):
        colour = tuple(rng.uniform(0.2, 0.8, 3).tolist())
        board = Paint(Material.POSTER, colour, _part(rng))
        y, wide, tall = rng.uniform([0.3, 0.25, 0.4], [1.7, 0.5, 1.3])
        yield boxes([x, y, z0], [x + wide, y + 0.05, z0 + tall], board)


def _cave(rng: np.random.Generator) -> HardScene:
    """A passage in rock, lit by a lamp beside the camera; what is farther away is black."""
    rock = Paint(Material.KERB, (0.46, 0.40, 0.34), _part(rng))
    along, angle = np.linspace(-1.0, 30.0, 240), np.linspace(0.0, 2.0 * np.pi, 91)
    x, a = np.meshgrid(along, angle, indexing="ij")
    bend = rng.uniform(-0.6, 0.6) * np.sin(along / 6.0)[:, None]
    flat = np.stack([x, 2.5 * np.cos(a), 2.5 * np.sin(a)], axis=-1).reshape(-1, 3)
    hills = value_noise(flat / 1.9, rock.part) + 0.4 * value_noise(flat / 0.6, rock.part + 1)
    hills += 0.12 * value_noise(flat / 0.19, rock.part + 2)
    radius = np.maximum(1.5 + 0.55 * hills.reshape(x.shape), 0.5)
    rings = np.stack([x, radius * np.cos(a) + bend, 1.3 + 0.8 * radius * np.sin(a)], axis=-1)
    rings[:, -1] = rings[:, 0]
    walls = np.concatenate([band(near, far) for near, far in pairwise(rings)])
    parts = [painted(walls, walls[..., :2].copy(), rock)]
    for _ in range(4):
        spot = at(float(rng.uniform(2.2, 6.0)), float(rng.uniform(-0.9, 0.9)), 0.2)
        stone = bumpy_ball(rng.uniform(0.15, 0.4, 3), rock, bump=0.3, wavelength=0.5)
        parts.append(move(stone, spot))
    pose = _looking((0.0, 0.0, 1.3), float(rng.uniform(-6, 6)), 5.0)
    return HardScene(merge(parts), pose, 0.12, _sun(0, -80), ((0.1, -0.45, 1.6, 40.0),), 0.33)


def _shelves(rng: np.random.Generator) -> HardScene:
    """Shelves whose plain boxes and books stand out by different depths."""
    wood = Paint(Material.WHITE, (0.66, 0.55, 0.42), _part(rng))
    white = Paint(Material.WHITE, (0.80, 0.78, 0.74), _part(rng))
    away, deep = float(rng.uniform(1.7, 2.2)), 0.55
    levels = np.arange(0.1, 2.5, 0.42)
    boards = [boxes([away, -1.8, z], [away + deep, 1.8, z + 0.025], wood) for z in levels]
    sides = [boxes([away, y, 0.0], [away + deep, y + 0.025, 2.4], wood) for y in (-1.8, -0.6, 0.6)]
    parts = [
        _ground(Paint(Material.WHITE, (0.45, 0.42, 0.40), _part(rng)), 6.0),
        quads([away + deep, -4.0, 0.0], [0, 8.0, 0], [0, 0, 3.0], white),
        *boards,
        *sides,
    ]
    for z in levels[:-1] + 0.026:
        y = -1.75
        while y < 1.5:
            wide, tall, front = rng.uniform([0.03, 0.12, 0.02], [0.24, 0.38, 0.45])
            kind = rng.choice([Material.WHITE, Material.PLAIN, Material.CAR_PAINT, Material.POSTER])
            paint = Paint(Material(kind), tuple(rng.uniform(0.15, 0.85, 3).tolist()), _part(rng))
            low, high = [away + front, y, z], [away + deep - 0.02, y + wide, z + tall]
            parts.append(boxes(low, high, paint))
            y += wide + (float(rng.uniform(0.05, 0.3)) if rng.random() < 0.25 else 0.004)
    pose = _looking((0.0, 0.0, 1.35), float(rng.uniform(-22, 22)), 4.0)
    lamps = ((0.1, 0.8, 2.6, 4.0), (-0.5, -1.5, 2.0, 2.0))
    return HardScene(merge(parts), pose, 0.16, _sun(180, 60), lamps)


def _floor(rng: np.random.Generator) -> HardScene:
    """A plain floor seen aslant, with weak texture and few things on it."""
    screed = Paint(Material.WHITE, (0.60, 0.57, 0.53), _part(rng))
    wall = Paint(Material.WHITE, (0.82, 0.82, 0.80), _part(rng))
    away = float(rng.uniform(6.0, 8.0))
    cardboard = Paint(Material.PLASTER, (0.60, 0.46, 0.32), _part(rng))
    y = float(rng.uniform(-0.9, 0.6))
    parts = [
        _ground(screed, 14.0),
        boxes([away, -9.0, 0.0], [away + 0.1, 9.0, 3.0], wall),
        boxes([away - 0.02, -9.0, 0.0], [away, 9.0, 0.10], replace(cardboard, part=4)),
        boxes([2.9, y, 0.0], [3.3, y + 0.5, 0.35], cardboard),
        move(cylinder((0.12, 0.10), 0.45, replace(cardboard, part=5), 24), at(4.3, -1.4 - y, 0.0)),
        boxes([away - 1.5, 1.2, 0.0], [away - 1.0, 2.2, 0.75], replace(wall, part=6)),
    ]
    pose = _looking((0.0, 0.0, 1.1), float(rng.uniform(-6, 6)), 16.0)
    lamps = ((5.0, 3.0, 2.8, 7.0), (1.0, -2.0, 2.8, 3.0))
    return HardScene(merge(parts), pose, 0.16, _sun(0, 80), lamps)


HARD_SCENES: Final[dict[str, Callable[[np.random.Generator], HardScene]]] = {
    "yard": _yard, "corner": _corner, "wires": _wires, "glass": _glass, "cave": _cave,
    "shelves": _shelves, "floor": _floor,
}  # fmt: skip
