"""Lays out a street from its seed: ground, houses, and the objects between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, pairwise, repeat
from typing import Final

import numpy as np

from recon.core.geometry import se3
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.arrays import Float64, freeze
from recon.street import props
from recon.street.materials import ROAD_HALF_M
from recon.street.path import BEHIND_M, CentreLine, camera_poses, centre_line
from recon.street.props import SECTION_M, SECTIONS, draw_plan, house
from recon.street.room import furnished_room, hand_poses, room_lap
from recon.street.settings import StreetScene, StreetSettings
from recon.street.shapes import Material, Paint, TriangleSoup, at, band, merge, move, painted

KERB_M: Final = 0.12  # pavement above road
_WALL_M: Final = 8.2  # distance of facades from the centre line
_AHEAD_M: Final = 110.0
_CAR_LANE_M: Final = 4.15
_SEEDLINGS: Final = 5
Layer = Callable[[CentreLine, float, np.random.Generator], Iterator[TriangleSoup]]
"""Lays out what stands on one side of a road: +1 is left."""


@dataclass(frozen=True, eq=False)
class StreetWorld:
    """A street, a rig and its path: everything that an image depends on. Axes: see `path`."""

    settings: StreetScene
    soup: TriangleSoup  # the scene, street axes
    camera: RectifiedCamera
    T_street_camera: Float64  # (frames, 4, 4), poses of the left camera
    to_sun: Float64  # (3,), unit vector towards the sun, street axes

    def __post_init__(self) -> None:
        freeze(self, "T_street_camera", np.float64, (self.settings.frames, 4, 4))
        freeze(self, "to_sun", np.float64, (3,))

    @property
    def T_world_street(self) -> Float64:
        """float64 (4, 4); world is the first left camera."""
        return se3.invert(self.T_street_camera[0])

    @property
    def trajectory(self) -> Trajectory:
        """True poses of the left camera; the first is the identity."""
        poses = self.T_world_street @ self.T_street_camera
        poses[0] = np.eye(4)
        return Trajectory(poses, np.arange(len(poses)) / self.settings.frame_rate_hz)

    @property
    def T_map_world(self) -> Float64:
        """float64 (4, 4); map axes: x along the first view, y left, z up; origin of the world."""
        forward = self.T_street_camera[0][:3, 2] * [1.0, 1.0, 0.0]
        forward /= np.linalg.norm(forward)
        up = np.array([0.0, 0.0, 1.0])
        R_map_street = np.stack([forward, np.cross(up, forward), up])
        return se3.make_transform(R_map_street @ self.T_street_camera[0][:3, :3], np.zeros(3))

    def ground_plane(self, index: int) -> Float64:
        """Return float64 (4,), see `SyntheticFrame.ground_plane`."""
        return np.array(self.T_street_camera[index][2])


def build_street(settings: StreetSettings) -> StreetWorld:
    """Lay out the street for some settings."""
    settings = StreetScene.of(settings)
    if settings.path == "room":
        road = room_lap(settings)
        soup, poses = furnished_room(settings, road), hand_poses(settings, road)
        return StreetWorld(settings, soup, rig(settings), poses, _sun(settings.seed))
    road, length = _road(settings)
    soup = merge(chain.from_iterable(street_parts(settings).values()))
    return StreetWorld(
        settings=settings,
        soup=soup if settings.repeat_m is None else _repeated(soup, settings.repeat_m, length),
        camera=rig(settings),
        T_street_camera=camera_poses(settings, road),
        to_sun=_sun(settings.seed),
    )


def street_parts(settings: StreetScene) -> dict[str, list[TriangleSoup]]:
    """Return what stands along a street by its kind, such as ``parked_cars``; street axes."""
    road, _ = _road(settings)
    layers: list[Layer] = [
        _houses,
        _backdrop,
        *([_fences, _trees] if settings.fences else [_parked_cars, _trees, _furniture]),
    ]
    parts = {"ground": [_ground(road)]}
    for number, layer in enumerate(layers):
        found = parts[layer.__name__.strip("_")] = []
        for side in (1.0, -1.0):
            stream = np.random.default_rng([settings.seed, number, int(side > 0)])
            found.extend(layer(road, side, stream))
    return parts


def _road(settings: StreetScene) -> tuple[CentreLine, float]:
    """Return the road of a street, and how long it is."""
    length = settings.frames * settings.speed_m_per_frame + _AHEAD_M
    return centre_line(settings, length + 60.0), length


def _repeated(period: TriangleSoup, repeat_m: float, length_m: float) -> TriangleSoup:
    shifts = repeat_m * np.arange(-math.ceil(BEHIND_M / repeat_m), math.ceil(length_m / repeat_m))
    return merge([move(period, at(shift, 0.0, 0.0)) for shift in shifts])


def rig(settings: StreetSettings) -> RectifiedCamera:
    """Return the rectified cameras of the settings, with principal points at the centre."""
    baseline_m = StreetScene.of(settings).baseline_m
    width, height = settings.width_px, settings.height_px
    cx, cy, focal = (width - 1) / 2, (height - 1) / 2, settings.focal_px
    return RectifiedCamera(focal, cx, cy, cx, baseline_m, width, height)


def _sun(seed: int) -> Float64:
    """Return direction to the sun: high and to one side of the street, so that one row is lit."""
    rng = np.random.default_rng([seed, 99])
    azimuth, climb = rng.choice([-1.0, 1.0]) * rng.uniform(1.1, 2.3), rng.uniform(0.75, 1.0)
    level = np.cos(climb)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(climb)])


def _ground(road: CentreLine) -> TriangleSoup:
    a, top = ROAD_HALF_M, KERB_M
    strips = [_strip(road, ((-a, 0.0), (a, 0.0)), Paint(Material.ASPHALT, (0.40, 0.40, 0.41)))]
    stone = Paint(Material.KERB, (0.58, 0.57, 0.55))
    slabs = Paint(Material.PAVING, (0.56, 0.54, 0.51))
    grass = Paint(Material.GRASS, (0.33, 0.38, 0.20))
    for side in (1.0, -1.0):
        wall = side * (_WALL_M + 3.0)
        rims = [(side * a, 0.0), (side * a, top), (side * (a + 0.15), top), (wall, top)]
        paints = [stone, stone, slabs]
        if not _inside(road, side):
            rims, paints = [*rims, (side * 60.0, top)], [*paints, grass]
        strips += map(_strip, repeat(road), pairwise(rims), paints)
        if _inside(road, side):
            strips.append(_yard(road, wall, grass))
    return merge(strips)


def _strip(road: CentreLine, edges: tuple[tuple[float, float], ...], paint: Paint) -> TriangleSoup:
    """Return a band along the road between two edges (lateral, height)."""
    along = _stations(road)
    rims, uvs = [], []
    for lateral, height in edges:
        y, z = np.full(len(along), lateral), np.full(len(along), height)
        rims.append(np.column_stack([road.points(along, y), z]))
        uvs.append(np.column_stack([along, y if edges[0][1] == edges[1][1] else z]))
    return painted(band(*rims), band(*uvs), paint)


def _stations(road: CentreLine) -> Float64:
    """Return where the strips of the ground are divided: every metre, and at the ends."""
    first, last = road.span_m
    if first < 0.0:  # an open road, whose ground continues beyond the last objects
        return np.arange(first, float(road.along_m[-1]) - 10.0, 1.0)
    return np.linspace(first, last, math.ceil(last - first) + 1)


def _yard(road: CentreLine, lateral_m: float, paint: Paint) -> TriangleSoup:
    """Return the ground inside a block: a fan from its centre to the inner edge of the pavement."""
    along = _stations(road)
    rim = road.points(along, np.full(len(along), lateral_m))
    middle = np.broadcast_to(rim.mean(axis=0), (len(rim) - 1, 2))
    uv = np.stack([rim[:-1], rim[1:], middle], axis=1)
    height = np.full((*uv.shape[:2], 1), KERB_M)
    return painted(np.concatenate([uv, height], axis=2), uv, paint)


def _inside(road: CentreLine, side: float) -> bool:
    return road.loop_m is not None and side > 0


def _houses(road: CentreLine, side: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    along, end = road.span_m
    while along < end:
        width = float(rng.uniform(8.0, 15.0))
        setback = float(rng.choice([0.0, 0.0, rng.uniform(0.3, 1.8)]))
        gap = float(rng.uniform(5.0, 8.0)) if rng.random() < 0.22 else float(rng.uniform(0.0, 0.15))
        if _room(road, side, along, width):
            yield _stand(road, along + width / 2, side * (_WALL_M + setback), width, rng)
        along += width + gap


def _backdrop(road: CentreLine, side: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    along, end = road.span_m
    end += 30.0 * (along < 0.0)
    while along < end:
        width = float(rng.uniform(11.0, 18.0))
        if not _inside(road, side) and _room(road, side, along, width):
            lateral_m = side * (_WALL_M + float(rng.uniform(20.0, 28.0)))
            yield _stand(road, along + width / 2, lateral_m, width, rng)
        along += width + float(rng.uniform(0.5, 3.0))


def _room(road: CentreLine, side: float, at_m: float, width_m: float) -> bool:
    """Return whether a house fits: within the lap or period, and not on the inside of a corner."""
    if road.span_m[0] < 0.0:
        return True
    end_m = at_m + width_m
    bends = abs(road.heading(end_m) - road.heading(at_m)) > 1e-6
    return end_m <= road.span_m[1] and not (_inside(road, side) and bends)


def _stand(
    road: CentreLine, middle_m: float, lateral_m: float, width_m: float, rng: np.random.Generator
) -> TriangleSoup:
    """Return a house on one side, with its facade on a chord of the curve."""
    built = house(draw_plan(width_m, rng), rng)
    T = road.place(middle_m, lateral_m, KERB_M)
    if lateral_m < 0:
        T = T @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return move(built, T @ at(-width_m / 2, 0.0, 0.0))


def _parked_cars(road: CentreLine, side: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    first, end = road.span_m
    for bay in np.arange(max(first, -18.0), end, 6.0):
        if rng.random() < 0.45:
            continue
        soup, jitter = props.car(rng), rng.normal(0.0, [0.25, 0.1, 0.02])
        T = road.place(float(bay) + 3.0 + jitter[0], side * _CAR_LANE_M + jitter[1])
        backwards = (side > 0) != (rng.random() < 0.1)
        yield move(soup, T @ at(0.0, 0.0, 0.0, jitter[2] + np.pi * backwards))


def _fences(road: CentreLine, side: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    first, end = road.span_m
    for along in np.arange(max(first, -18.0), end, SECTION_M + 0.6):
        section = SECTIONS[int(rng.integers(len(SECTIONS)))](rng)
        T = road.place(float(along), side * (ROAD_HALF_M + 1.5), KERB_M)
        yield move(section, T @ np.diag([1.0, side, 1.0, 1.0]))


def _trees(road: CentreLine, side: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    seedlings = [props.tree(rng) for _ in range(_SEEDLINGS)]

    def grow(at_m: float, lateral_m: float) -> TriangleSoup:
        turn = at(0.0, 0.0, 0.0, float(rng.uniform(0.0, 2.0 * np.pi)))
        T = road.place(at_m, lateral_m, KERB_M) @ turn
        return move(seedlings[int(rng.integers(_SEEDLINGS))], T)

    first, end = road.span_m
    along = max(first, -10.0) + float(rng.uniform(0.0, 8.0))
    while along < end:
        yield grow(along, side * (ROAD_HALF_M + 0.75))
        along += float(rng.uniform(9.0, 22.0))
    for lateral in np.arange(1.0, 26.0, 3.2) if first < 0.0 else ():
        yield grow(end + 8.0 + float(rng.uniform(0.0, 4.0)), side * float(lateral))


def _furniture(road: CentreLine, side: float, rng: np.random.Generator) -> Iterator[TriangleSoup]:
    kerb = side * (ROAD_HALF_M + 0.45)
    # Separate random streams, as the number of posts must not change the objects between them.
    lamps, rng = rng.spawn(2)
    first, end = road.span_m
    for along in np.arange(max(first, -12.0) + 12.0 * (side > 0), end, 24.0):
        yield move(props.lamp_post(side, lamps), road.place(float(along), kerb, KERB_M))
    along = max(first, -8.0)
    while along < end:
        along += float(rng.uniform(2.5, 9.0))
        kind = rng.random()
        if kind < 0.3:
            yield move(props.sign(rng), road.place(along, kerb, KERB_M))
        elif kind < 0.6:
            for k in range(int(rng.integers(2, 5))):
                yield move(props.bollard(rng), road.place(along + 1.5 * k, kerb, KERB_M))
        elif kind < 0.85:
            yield move(props.bin_(rng), road.place(along, side * (_WALL_M - 0.6), KERB_M))
        else:
            T = road.place(along, side * (ROAD_HALF_M + 1.2), KERB_M)
            yield move(props.advertising_pillar(rng), T)
