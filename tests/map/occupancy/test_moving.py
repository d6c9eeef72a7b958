"""What moved is taken out of the fused cloud; what stands still, far or thin, stays in it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.geometry.se3 import make_transform, transform_cloud
from recon.core.kernels.voxels import pack_keys
from recon.core.values import OccupancyVoxels, PointCloud, RayCloud, join_clouds
from recon.core.values.arrays import Bool
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.occupancy.bodies import Looks
from recon.map.occupancy.builder import thin_rays
from recon.map.occupancy.moving import find_moved, looked_through
from recon.map.submaps import Submap, SubmapBuilder
from recon.map.tiles import Tiles

HEIGHT_M, WALL_M, RANGE_M = 1.65, 30.0, 18.0
T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
CONFIG = load_config()
SIGMA_PX, FOCAL_BASELINE = 0.3, 360.0 * 0.54
Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Centre of the base (right, above the ground, forward) and size (wide, high, long), metres."""
CAR, PERSON, POST, WIRE = (1.8, 1.4, 4.2), (0.5, 1.75, 0.4), (0.12, 4.0, 0.12), (12.0, 0.04, 0.04)


def _depths(rays: np.ndarray, boxes: Sequence[Box], z_m: float, wall_m: float) -> np.ndarray:
    """Depth of the nearest of ground, end wall and boxes along each ray of unit depth."""
    with np.errstate(divide="ignore"):
        depth = np.minimum(wall_m - z_m, np.where(rays[:, 1] > 0, HEIGHT_M / rays[:, 1], np.inf))
        for (x, up, z), (wide, high, long) in boxes:
            low = np.array([x - wide / 2, HEIGHT_M - up - high, z - z_m - long / 2])
            size = np.array([wide, high, long])
            ends = np.stack([low / rays, (low + size) / rays])
            enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
            depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    return depth


def look(boxes: Sequence[Box], z_m: float, seed: int, wall_m: float = WALL_M) -> PointCloud:
    """What a stereo camera at z sees, with the depth error of stereo."""
    u, v = np.meshgrid(np.linspace(-0.8, 0.8, 340), np.linspace(-0.3, 0.3, 130))
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3)
    depth = _depths(rays, boxes, z_m, wall_m)
    sigma = depth**2 * SIGMA_PX / FOCAL_BASELINE
    seen = depth + np.random.default_rng(seed).normal(size=len(depth)) * sigma
    cloud = PointCloud((rays * seen[:, None]).astype("f4"), sigma_m=sigma.astype("f4"))
    return cloud.select(depth < 60.0)


class Drive(NamedTuple):
    """A drive of one submap, where its frames were taken, and their rays."""

    submap: Submap
    poses: list[np.ndarray]
    rays: list[RayCloud]


def _drive(scenes: Sequence[Sequence[Box]], step_m: float = 0.5, aside: float = 0.0) -> Drive:
    """A drive through a scene that changes from frame to frame."""
    poses, kept = [], []
    builder = SubmapBuilder(CONFIG.submaps, CONFIG.fusion, CONFIG.occupancy, T_MAP_WORLD)
    for frame, boxes in enumerate(scenes):
        T = make_transform(np.eye(3), np.array([aside, 0.0, step_m * frame]))
        shifted = [((x - aside, up, z), size) for (x, up, z), size in boxes]
        cloud = look(shifted, step_m * frame, frame)
        rays = thin_rays(cloud, CONFIG.occupancy)
        near = cloud.select(cloud.xyz[:, 2] < RANGE_M)
        builder.integrate(transform_cloud(near, T, frame="world"), rays.cloud(), T)
        poses.append(T)
        kept.append(rays)
    return Drive(builder.close(), poses, kept)


def _looks(drives: Sequence[Drive]) -> Looks:
    poses = np.stack([pose for drive in drives for pose in drive.poses])
    rays = [cloud for drive in drives for cloud in drive.rays]
    return Looks(CONFIG.occupancy, T_MAP_WORLD @ poses, rays.__getitem__)


def _tiles(*drives: Drive, remove: bool = True) -> Tiles:
    fusion = CONFIG.fusion.model_copy(update={"remove_moving": remove})
    config = CONFIG.model_copy(update={"fusion": fusion})
    submaps = [drive.submap for drive in drives]
    tiles = Tiles.of_submaps(submaps, config, T_MAP_WORLD, drives=[1] * len(drives))
    return tiles.with_looks(_looks(drives))


def _cloud(*drives: Drive, remove: bool = True) -> PointCloud:
    return join_clouds(tile.cloud for tile in _tiles(*drives, remove=remove))


def _near(cloud: PointCloud, boxes: Sequence[Box], margin_m: float = 0.25) -> Bool:
    """Points in a box or near it, higher than the ground reaches."""
    right, up, forward = -cloud.xyz[:, 1], cloud.xyz[:, 2] + HEIGHT_M, cloud.xyz[:, 0]
    found = np.zeros(len(cloud), np.bool_)
    for (x, base, z), (wide, high, long) in boxes:
        near = np.abs(right - x) < wide / 2 + margin_m
        near &= np.abs(forward - z) < long / 2 + margin_m
        near &= forward < WALL_M - 1.0
        found |= near & (up > max(base - margin_m, 0.25)) & (up < base + high + margin_m)
    return found


def _left(of: Sequence[Box], *drives: Drive) -> float:
    """Share of the points near boxes that are still there."""
    before, after = (_cloud(*drives, remove=on) for on in (False, True))
    assert _near(before, of).sum() > 100
    return float(_near(after, of).sum() / _near(before, of).sum())


FRAMES = 24
ONCOMING = [[((-3.0, 0.0, 34.0 - 1.5 * n), CAR)] for n in range(FRAMES)]
CROSSING = [[((-7.0 + 0.6 * n, 0.0, 17.0), CAR)] for n in range(FRAMES)]
LEADING = [[((0.5, 0.0, 8.0 + 0.9 * n), CAR)] for n in range(FRAMES)]
WALKING = [[((3.0, 0.0, 12.0 + 0.2 * n), PERSON)] for n in range(FRAMES)]
STANDING: list[Box] = [
    ((4.0, 0.0, 14.0), POST),
    ((-4.0, 0.0, 22.0), POST),
    ((0.0, 3.8, 18.0), WIRE),
]
VAN = (1.8, 2.0, 4.2)
PARKED: list[Box] = [((3.0, 0.0, 16.0), VAN)]


@pytest.mark.parametrize("scenes", [ONCOMING, CROSSING, LEADING, WALKING])
def test_what_moved_is_gone(scenes: list[list[Box]]) -> None:
    trail, drive = [box for boxes in scenes for box in boxes], _drive(scenes)
    assert _left(trail, drive) <= 0.05
    removed = join_clouds(tile.removed for tile in _tiles(drive))
    assert _near(removed, trail).mean() > 0.85
    assert removed.sigma_m is not None


class Came:
    """Frames in which some cells were hit, all at once, after they were looked through."""

    def at(self, keys: np.ndarray) -> Iterable[np.ndarray]:
        """Two frames of each."""
        return (np.full(len(keys), sign, np.int8) for sign in (-1, -1, 1, 1))


def _found(cells: np.ndarray, seen: np.ndarray, in_the_end: np.ndarray) -> Bool:
    """Which of these cells moved, by what a drive saw in them and by what all saw in the end."""
    keys = pack_keys(cells)
    order = np.argsort(keys)
    return find_moved(
        (cells + 0.5) * 0.2,
        np.zeros(len(cells), np.float32),
        np.ones(len(cells), np.bool_),
        OccupancyVoxels(cells, in_the_end, 0.2),
        (keys[order], seen[order]),
        Came(),
    )


def test_what_moved_grows_along_an_upright_surface_but_not_over_the_ground() -> None:
    # A wall over the line y = 0 and the ground beside it: free, unsure, surely occupied along x.
    wall = np.stack(np.meshgrid(np.arange(14), [0], np.arange(1, 7)), -1).reshape(-1, 3)
    ground = np.stack(np.meshgrid(np.arange(14), np.arange(-6, 7), [-2]), -1).reshape(-1, 3)
    cells = np.concatenate([wall, ground]).astype(np.int32)
    x = cells[:, 0]
    seen = np.where(x < 5, -2.0, np.where(x < 9, 0.5, 2.0)).astype(np.float32)
    moved = _found(cells, seen, seen)
    # What a later drive looked through outweighs what stood: of the wall 0 to 6 are free in the
    # end; 7, between a free one and one that stands, goes with them.
    later = np.where(wall[:, 0] < 7, -1.0, 2.0).astype(np.float32)
    gone = _found(wall.astype(np.int32), np.full(len(wall), 2.0, np.float32), later)
    assert set(wall[gone, 0].tolist()) == set(range(8))
    upright = np.arange(len(cells)) < len(wall)
    # What counts is the mean over a cell and those that touch it: 5 is free, 8 stands.
    assert set(x[moved & upright].tolist()) == set(range(8))
    assert set(x[moved & ~upright].tolist()) == set(range(6))


def test_what_stands_still_stays_even_if_it_is_thin() -> None:
    drive = _drive([STANDING] * FRAMES)
    before, after = (_cloud(drive, remove=on) for on in (False, True))
    assert len(after) >= 0.99 * len(before)
    for box in STANDING:
        assert _near(after, [box], 0.1).sum() >= 0.98 * _near(before, [box], 0.1).sum() > 100


def test_a_parked_car_that_a_later_drive_looked_through_is_gone() -> None:
    older, later = _drive([PARKED] * FRAMES), _drive([[]] * FRAMES, aside=0.5)
    assert _left(PARKED, older, later) <= 0.05
    assert _left(PARKED, older) >= 0.95
    assert _left(PARKED, later, older) >= 0.95


def test_a_roof_just_below_the_camera_keeps_most_of_its_points() -> None:
    # Rays graze it: a third of its voxels are seen through more often than hit.
    car: list[Box] = [((3.0, 0.0, 16.0), CAR)]
    assert _left(car, _drive([car] * FRAMES)) >= 0.85


def _fence(frame: int) -> list[Box]:
    """A fence 12 m long, and a wall behind it; a frame sees every third board or another."""
    boards = [((x, 0.0, 12.0), (0.2, 1.2, 0.05)) for x in np.arange(-6.0, 6.0, 0.2)]
    seen = np.random.default_rng(frame).random(len(boards)) < 0.35
    return [board for board, on in zip(boards, seen, strict=True) if on]


def test_a_fence_that_is_looked_through_as_often_as_it_is_hit_stays() -> None:
    scenes = [_fence(frame) for frame in range(FRAMES)]
    drive = _drive(scenes, step_m=0.2)
    whole: list[Box] = [((0.0, 0.3, 12.0), (12.0, 0.9, 0.1))]
    before = _near(_cloud(drive, remove=False), whole, 0.1).sum()
    assert before > 300
    # It is free for most rays: the sums of hits and rays alone would take it out.
    points = _cloud(drive, remove=False)
    in_the_end = drive.submap.occupancy.voxels(CONFIG.occupancy.resolution_m)
    free = np.sort(pack_keys(in_the_end.keys[in_the_end.log_odds <= 0]))
    cells = np.floor(points.xyz[_near(points, whole, 0.1)] / CONFIG.occupancy.resolution_m)
    assert np.isin(pack_keys(cells.astype(np.int64)), free).mean() > 0.25
    assert _near(_cloud(drive), whole, 0.1).sum() >= 0.99 * before


@pytest.mark.parametrize(
    ("free", "taken", "points", "expected"),
    [
        ([(0, 0, 0), (-7, 3, 2)], [(5, 5, 5)], [(0, 0, 0), (-7, 3, 2)], [True, True]),
        # beside an occupied one
        ([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 1, 0)], [(1, 1, 1), (2, 2, 2)], [False, True]),
        # occupied, unknown
        ([(0, 0, 0)], [(4, 4, 4)], [(4, 4, 4), (9, 9, 9)], [False, False]),
        ([], [], [(0, 0, 0)], [False]),
        ([(0, 0, 0)], [], [], []),
        ([(0, 0, 0)], [], [(0, 0, 0)], [True]),
    ],
)
def test_free_cells_that_touch_nothing_occupied_are_looked_through(
    free: list, taken: list, points: list, expected: list[bool]
) -> None:
    keys = np.array(free + taken, dtype=np.int32).reshape(-1, 3)
    log_odds = np.array([-1.0] * len(free) + [1.0] * len(taken), dtype=np.float32)
    places = (np.array(points, np.float32).reshape(-1, 3) + 0.5) * np.float32(0.2)
    assert looked_through(places, OccupancyVoxels(keys, log_odds, 0.2)).tolist() == expected
