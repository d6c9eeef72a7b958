"""What moved leaves no ghosts in voxels and is taken out of the cloud; what stands still stays."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.geometry.se3 import apply, exp_so3, make_transform, transform_cloud
from recon.core.kernels.voxels import pack_keys
from recon.core.values import FREE, OCCUPIED, OccupancyGrid, PointCloud, RayCloud, join_clouds
from recon.core.values.arrays import Bool
from recon.core.values.grid import log_odds
from recon.export.cloud import export_cloud
from recon.map.builders import MAX_PROBABILITY, OccupancyBuilder, Submap, thin_rays
from recon.map.drive.mapper import SubmapBuilder
from recon.map.drive.sequence import map_sequence
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.ground.grid import GridSettings, flatten
from recon.map.ground.surface import GroundSurface
from recon.map.occupancy.bodies import (
    FrameObservations,
    disagreement,
    dynamic_cells,
    frame_pairs,
    still_there,
)
from recon.map.tiles import Tiles
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene

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
    u, v = np.meshgrid(np.linspace(-0.8, 0.8, 340), np.linspace(-0.3, 0.3, 130))
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3)
    depth = _depths(rays, boxes, z_m, wall_m)
    sigma = depth**2 * SIGMA_PX / FOCAL_BASELINE
    seen = depth + np.random.default_rng(seed).normal(size=len(depth)) * sigma
    cloud = PointCloud((rays * seen[:, None]).astype("f4"), sigma_m=sigma.astype("f4"))
    return cloud.select(depth < 60.0)


class Drive(NamedTuple):
    submap: Submap
    poses: list[np.ndarray]
    rays: list[RayCloud]


def _drive(
    scenes: Sequence[Sequence[Box]],
    step_m: float = 0.5,
    aside: float = 0.0,
    off_px: np.ndarray | None = None,
    off_m: np.ndarray | None = None,
) -> Drive:
    """A drive through a scene that changes from frame to frame.

    ``off_px`` is the error of all disparities of each frame, ``off_m`` (F, 3) that of its place.
    """
    off_px = np.zeros(len(scenes)) if off_px is None else off_px
    off_m = np.zeros((len(scenes), 3)) if off_m is None else off_m
    poses, kept = [], []
    builder = SubmapBuilder(CONFIG.submaps, CONFIG.fusion, CONFIG.occupancy, T_MAP_WORLD)
    for frame, boxes in enumerate(scenes):
        T = make_transform(np.eye(3), np.array([aside, 0.0, step_m * frame]))
        shifted = [((x - aside, up, z), size) for (x, up, z), size in boxes]
        cloud = _off(look(shifted, step_m * frame, frame), off_px[frame])
        T[:3, 3] += off_m[frame]
        kept.append(thin_rays(cloud, CONFIG.occupancy))
        near = cloud.select(cloud.xyz[:, 2] < RANGE_M)
        builder.integrate(transform_cloud(near, T, frame="world"), kept[-1].cloud(), T)
        poses.append(T)
    return Drive(builder.close(), poses, kept)


def _off(cloud: PointCloud, off_px: float) -> PointCloud:
    """What a rig sees whose disparities are too large by so much."""
    ratio = FOCAL_BASELINE / (FOCAL_BASELINE + off_px * cloud.xyz[:, 2:])
    return replace(cloud, xyz=(cloud.xyz * ratio).astype("f4"))


def _tiles(*drives: Drive, remove: bool = True) -> Tiles:
    config = load_config(None, [f"fusion.remove_moving={str(remove).lower()}"])
    submaps = [drive.submap for drive in drives]
    tiles = Tiles.of_submaps(submaps, config, T_MAP_WORLD, drives=[1] * len(drives))
    poses = np.stack([pose for drive in drives for pose in drive.poses])
    rays = [cloud for drive in drives for cloud in drive.rays]
    tiles.observations = FrameObservations(config.occupancy, T_MAP_WORLD @ poses, rays.__getitem__)
    return tiles


def _clouds(*drives: Drive) -> list[PointCloud]:
    return [join_clouds(t.cloud for t in _tiles(*drives, remove=on)) for on in (False, True)]


def _near(
    cloud: PointCloud, boxes: Sequence[Box], margin_m: float = 0.25, lowest_m: float = 0.25
) -> Bool:
    """Points in a box or near it, higher than the ground reaches."""
    right, up, forward = -cloud.xyz[:, 1], cloud.xyz[:, 2] + HEIGHT_M, cloud.xyz[:, 0]
    found = np.zeros(len(cloud), np.bool_)
    for (x, base, z), (wide, high, long) in boxes:
        near = np.abs(right - x) < wide / 2 + margin_m
        near &= np.abs(forward - z) < long / 2 + margin_m
        near &= forward < WALL_M - 1.0
        found |= near & (up > max(base - margin_m, lowest_m)) & (up < base + high + margin_m)
    return found


def _left(of: Sequence[Box], *drives: Drive, margin_m: float = 0.25) -> float:
    before, after = (_near(cloud, of, margin_m).sum() for cloud in _clouds(*drives))
    assert before > 100
    return float(after / before)


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
def test_what_moved_is_gone(scenes):
    trail, drive = [box for boxes in scenes for box in boxes], _drive(scenes)
    assert _left(trail, drive) <= 0.05
    removed = join_clouds(tile.removed for tile in _tiles(drive))
    assert _near(removed, trail, lowest_m=0.05).mean() > 0.85
    # Of what is 3 to 20 m away, each as sure as the points that it was made of.
    assert (removed.sigma_m > 0).all()
    assert removed.sigma_m.max() < 0.5


def _trail(drive: Drive, scenes: Sequence[Sequence[Box]], ground_m: float, *, remove: bool):
    """Heights above the ground of points where something was, and whether they are of the kerb."""
    cloud = join_clouds(tile.cloud for tile in _tiles(drive, remove=remove))
    lowered = replace(cloud, xyz=cloud.xyz - np.float32([0, 0, ground_m + HEIGHT_M]))
    trail = [box for boxes in scenes for box in boxes]
    there = lowered.select(_near(lowered, trail, 0.15, lowest_m=-0.3))
    return there.xyz[:, 2] + HEIGHT_M, np.abs(there.xyz[:, 1] - 3.0) < 0.2


# The voxel of the ground, 0.2 m high, ends 5, 15 and 20 cm above it.
@pytest.mark.parametrize(
    ("scenes", "ground_m"), [(ONCOMING, -1.65), (ONCOMING, -1.75), (CROSSING, 0.0)]
)
def test_below_what_moved_is_ground_or_nothing(scenes, ground_m, monkeypatch):
    T_map_world = make_transform(AXES_MAP_WORLD, np.array([0.0, 0.0, ground_m + HEIGHT_M]))
    monkeypatch.setitem(globals(), "T_MAP_WORLD", T_map_world)
    drive = _drive(scenes)
    (before, _), (after, _) = (_trail(drive, scenes, ground_m, remove=on) for on in (False, True))
    # Up to a voxel of the cloud, and the noise of the ground, a point may be of both.
    low = [((heights > 0.15) & (heights < 0.3)).sum() for heights in (before, after)]
    assert low[0] > 50
    assert low[1] <= 0.15 * low[0]
    ground = [(np.abs(heights) < 0.05).sum() for heights in (before, after)]
    assert ground[1] >= 0.98 * ground[0] > 1000


def test_what_stands_still_stays_even_if_it_is_thin():
    before, after = _clouds(_drive([STANDING] * FRAMES))
    assert len(after) >= 0.99 * len(before)
    for box in STANDING:
        assert _near(after, [box], 0.1).sum() >= 0.98 * _near(before, [box], 0.1).sum() > 100
    # Rays graze a roof just below the camera: a third of its voxels are seen through more often
    # than hit.
    car: list[Box] = [((3.0, 0.0, 16.0), CAR)]
    assert _left(car, _drive([car] * FRAMES)) >= 0.85


def test_a_parked_car_that_a_later_drive_looked_through_is_gone():
    older, later = _drive([PARKED] * FRAMES), _drive([[]] * FRAMES, aside=0.5)
    assert _left(PARKED, older, later) <= 0.05
    assert _left(PARKED, older) >= 0.95
    assert _left(PARKED, later, older) >= 0.95


def test_a_fence_that_is_looked_through_as_often_as_it_is_hit_stays():
    # 12 m long, with a wall behind it; a frame sees every third board or another.
    boards = [((x, 0.0, 12.0), (0.2, 1.2, 0.05)) for x in np.arange(-6.0, 6.0, 0.2)]
    seen = [np.random.default_rng(frame).random(60) < 0.35 for frame in range(FRAMES)]
    drive = _drive([[*compress(boards, on)] for on in seen], step_m=0.2)
    whole: list[Box] = [((0.0, 0.3, 12.0), (12.0, 0.9, 0.1))]
    points = _clouds(drive)[0]
    # It is free for most rays: the sums of hits and rays alone would take it out.
    in_the_end = drive.submap.occupancy.voxels(CONFIG.occupancy.resolution_m)
    free = np.sort(pack_keys(in_the_end.keys[in_the_end.log_odds <= 0]))
    cells = np.floor(points.xyz[_near(points, whole, 0.1)] / CONFIG.occupancy.resolution_m)
    assert np.isin(pack_keys(cells.astype(np.int64)), free).mean() > 0.25
    assert _left(whole, drive, margin_m=0.1) >= 0.99


STREET: list[Box] = [
    ((5.0, 0.0, 20.0), (0.2, 4.0, 44.0)),
    ((-3.5, 0.0, 16.0), (1.8, 1.6, 4.2)),
    ((-3.5, 0.0, 24.0), (1.8, 1.6, 4.2)),
]
"""A façade along the street, and two parked cars."""
LESS = 16  # frames, at 0.75 m
WANDER = np.linspace(-2.0, 2.0, LESS)
DRIFT = np.random.default_rng(3).normal(0.0, 0.07, (LESS, 3)).cumsum(axis=0) * [1, 0, 1]


@pytest.mark.parametrize("errors", [{"off_px": WANDER}, {"off_m": DRIFT}], ids=["rig", "path"])
def test_what_only_the_error_of_a_rig_or_of_a_path_moves_stays(errors):
    before, after = _clouds(_drive([STREET] * LESS, step_m=0.75, **errors))
    assert len(after) >= 0.995 * len(before)


@pytest.mark.slow
def test_two_rigs_that_disagree_take_nothing_out_but_what_left_between_their_drives():
    off = np.full(FRAMES, 1.0)
    rigs = _drive([STREET] * FRAMES, off_px=off), _drive([STREET] * FRAMES, off_px=-off)
    before, after = _clouds(*rigs)
    assert len(after) >= 0.995 * len(before)
    older = _drive([[*STREET, *PARKED]] * FRAMES, off_px=0.25 * off)
    later = _drive([STREET] * FRAMES, aside=0.5, off_px=-0.25 * off)
    assert _left(PARKED, older, later, margin_m=0.0) <= 0.05


@pytest.mark.parametrize("off_px", [0.0, 1.0, 3.0])
def test_disagreement_is_the_error_of_an_inverse_depth(off_px):
    # One frame is right, the other as far off as two that err apart by the root of two.
    clouds = [thin_rays(_off(look(STREET, 0.0, n), n * off_px), CONFIG.occupancy) for n in (0, 1)]
    poses = np.stack([T_MAP_WORLD @ np.eye(4)] * 2)
    error_px = (
        FrameObservations(CONFIG.occupancy, poses, clouds.__getitem__).disagreement * FOCAL_BASELINE
    )
    # A median of sizes is that of the shift, as soon as it is larger than the noise.
    assert np.hypot(0.5 * SIGMA_PX, off_px) <= error_px <= 1.2 * np.hypot(SIGMA_PX, 1.1 * off_px)


def test_frames_are_compared_that_are_near_look_the_same_way_and_are_far_apart_in_time():
    there_and_back = np.concatenate([np.arange(0.0, 20.0), np.arange(20.0, 0.0, -1.0)])
    poses = np.stack([make_transform(np.eye(3), np.array([0.0, 0.0, z])) for z in there_and_back])
    pairs = dict(frame_pairs(poses, 20.0))
    assert pairs[0] == len(poses) - 1
    assert all(abs(there_and_back[one] - there_and_back[two]) <= 5.0 for one, two in pairs.items())
    poses[20:, :3, :3] = exp_so3(np.array([0.0, np.pi, 0.0]))
    assert dict(frame_pairs(poses, 20.0))[0] == 5
    assert not list(frame_pairs(poses[:1], 20.0))


def test_a_frame_alone_or_that_sees_nothing_disagrees_with_none():
    nothing = PointCloud(np.zeros((0, 3), "f4"))
    assert disagreement([], CONFIG.occupancy) == 0.0
    views = [(nothing, look([], 0.0, 0), np.eye(4)), (look([], 0.0, 0), nothing, np.eye(4))]
    assert disagreement(views, CONFIG.occupancy) == 0.0


def test_a_surface_is_still_there_up_to_its_reach_before_and_behind_a_cell():
    cells = np.array([[0, 0, z] for z in (0, 3, 9)])
    occupied = np.sort(pack_keys(np.array([[6, 0, 0], [-4, 0, 3], [0, 5, 9]])))
    for length, found in ((3.0, [False] * 3), (4.0, [False, True, False]), (6.5, [True] * 2)):
        reach = np.array([[length, 0.0, 0.0]] * 3)
        assert still_there(pack_keys(cells), reach, occupied)[: len(found)].tolist() == found
    assert still_there(pack_keys(cells[:0]), np.zeros((0, 3)), occupied).tolist() == []


GROUND = GroundSurface(np.full((60, 60), -HEIGHT_M), 1.0, (-15.0, -30.0))


def _grid(cars: list[tuple[float, float] | None], step_m: float = 0.0) -> OccupancyGrid:
    """The grid after frames with the car's rear at (x, z), before a wall; the camera moves on."""
    builder = OccupancyBuilder(CONFIG.occupancy, T_MAP_WORLD)
    for index, car in enumerate(cars):
        z_m = index * step_m
        boxes = [] if car is None else [((car[0], 0.0, car[1] + 2.1), CAR)]
        rays = thin_rays(look(boxes, z_m, index, wall_m=20.0), CONFIG.occupancy)
        builder.integrate(rays.cloud(), make_transform(np.eye(3), np.array([0.0, 0.0, z_m])))
    return flatten(builder.voxels(), GROUND, GridSettings())


def _cells(grid: OccupancyGrid, forward_m: tuple[float, float], left_m: tuple[float, float]):
    (x0, x1), (y0, y1) = (
        np.rint((np.array(span) - origin) / grid.resolution_m).astype(int)
        for span, origin in zip((forward_m, left_m), grid.origin_m, strict=True)
    )
    return grid.cells[y0:y1, x0:x1]


PLACE = (9.0, 13.0), (-1.4, 1.4)


def test_a_car_that_stops_where_it_was_free_is_found_within_a_second():
    assert (_cells(_grid([(0.0, 9.0)] * 20), *PLACE) == OCCUPIED).sum() > 8
    # Ten frames; until then, what was free is at least no longer called so.
    place, stopped = ((9.0, 9.2), (-0.8, 0.8)), [(0.0, 9.05)] * 10
    assert (_cells(_grid([*[None] * 20, *stopped]), *place) == OCCUPIED).all()
    assert not (_cells(_grid([*[None] * 20, *stopped[:4]]), *place) == FREE).any()


def test_without_rays_nothing_is_left_out_and_it_is_said(tmp_path):
    config = load_config(overrides=["occupancy.keep_rays=false"])
    source = SyntheticSource(StreetScene(frames=3, path="straight", width_px=160, height_px=64))
    mapped = map_sequence(source, config, known_poses=source.trajectory)
    written = export_cloud(mapped.tiles, tmp_path / "cloud.ply", tmp_path / "removed.ply")
    assert written.figures.to_json()["points_removed"] == 0
    assert any("keep_rays=true" in line for line in written.warnings)


WALL = np.stack(np.meshgrid(np.arange(8), [0], np.arange(8)), -1).reshape(-1, 3)
LOOKS = 30


def _judged(cells: np.ndarray, seen: np.ndarray, placed: np.ndarray | None = None) -> np.ndarray:
    """Judge cells (N, 3) of which frames saw (F, N)."""
    keys = pack_keys(cells)
    order = np.argsort(keys)
    sure = np.ones(len(cells), np.bool_) if placed is None else placed
    judged = np.zeros(len(cells), np.bool_)
    judged[order] = dynamic_cells(keys[order], sure[order], seen[:, order].astype(np.int8))
    return judged


def _while(frames: slice, number: int) -> np.ndarray:
    seen = np.full((LOOKS, number), -1)
    seen[frames] = 1
    return seen


def _at_random(ratio: float) -> np.ndarray:
    return np.where(np.random.default_rng(3).random((LOOKS, len(WALL))) < ratio, 1, -1)


SINCE = np.arange(LOOKS)[:, None] - 2 * WALL[:, 0]
BOARDS = np.random.default_rng(3).random((LOOKS, 8)) < 0.3
BODY = _while(slice(5, 9), len(WALL))
POSES_BEFORE_LINKS = _while(slice(3, 5), 1)


@pytest.mark.parametrize(("seen", "moved"), [
    (BODY, True),
    (np.maximum(BODY, _while(slice(20, 24), len(WALL))), True),  # one after the other
    # Column after column is hit, each for six frames: it enters by one edge.
    (np.where((SINCE >= 3) & (SINCE < 9), 1, -1), True),
    *((_at_random(ratio), False) for ratio in (0.1, 0.3, 0.5)),
    # Boards of a fence are hit or looked through from top to bottom, whatever the others are.
    (np.where(BOARDS[:, WALL[:, 0]], 1, -1), False),
    *((np.full((LOOKS, len(WALL)), always), False) for always in (-1, 0, 1)),
    # One cell alone: hit in one run of frames, in two, or never looked through.
    (POSES_BEFORE_LINKS, True),
    (np.maximum(POSES_BEFORE_LINKS, _while(slice(9, 10), 1)), False),
    (np.maximum(POSES_BEFORE_LINKS, 0), False),
])  # fmt: skip
def test_what_was_there_as_a_whole_for_a_while_moved(seen, moved):
    assert (_judged(WALL[: seen.shape[1]], seen) == moved).all()


def test_what_is_apart_from_a_body_did_not_move():
    cells = np.concatenate([WALL, WALL + np.array([20, 0, 0])])
    judged = _judged(cells, np.concatenate([BODY, _at_random(0.5)], axis=1))
    assert judged.tolist() == [True] * len(WALL) + [False] * len(WALL)
    assert len(_judged(WALL[:0], np.zeros((LOOKS, 0)))) == 0


def test_cells_that_frames_could_place_outweigh_the_others_of_their_piece():
    placed = WALL[:, 0] < 3
    rng = np.random.default_rng(9)
    noise = np.where(rng.random((LOOKS, len(WALL))) < 0.4, 1, -1)
    assert _judged(WALL, np.where(placed, BODY, noise), placed).all()
    assert not _judged(WALL, np.where(placed, noise, BODY), placed).any()
    assert _judged(WALL, BODY, np.zeros(len(WALL), np.bool_)).all()
    # Three of them, which five frames saw differently, are too few.
    few = (WALL[:, 0] == 3) & (WALL[:, 2] < 3)
    differ = few & (WALL[:, 2] == 1) & (np.arange(LOOKS)[:, None] < 5)
    assert _judged(WALL, np.where(differ, 1, BODY), few).all()


def test_cells_of_which_too_little_is_known_belong_to_a_body_beside_them():
    beside = [[9, 0, 0], [12, 0, 0]]  # each two cells from the one before, both alone
    seen = np.concatenate([BODY, np.zeros((LOOKS, 2))], axis=1)
    assert _judged(np.concatenate([WALL, beside]), seen)[len(WALL) :].tolist() == [True, False]


def _poses_and_clouds(number: int) -> tuple[np.ndarray, list[PointCloud]]:
    """Poses that look here and there, and clouds of slopes up to 1.2 on either side."""
    rng = np.random.default_rng(4)
    poses, clouds = [], []
    for _ in range(number):
        turn = exp_so3(rng.normal(0.0, 0.5, 3))
        poses.append(make_transform(turn, rng.normal(0.0, 1.0, 3)))
        depth = np.repeat(rng.uniform(1.0, 20.0, 300), 30)
        slopes = np.repeat(rng.uniform(-1.2, 1.2, (300, 2)), 30, axis=0)
        slopes += rng.normal(0.0, 0.01, slopes.shape)
        xyz = np.column_stack([slopes * depth[:, None], depth]).astype("f4")
        clouds.append(PointCloud(xyz, sigma_m=(0.002 * depth**2).astype("f4")))
    return np.stack(poses), clouds


def test_chosen_rays_see_in_cells_what_all_rays_see():
    poses, clouds = _poses_and_clouds(6)
    rays = [thin_rays(cloud, CONFIG.occupancy) for cloud in clouds]
    rng = np.random.default_rng(8)
    ends = [apply(T, cloud.xyz[::50]) for T, cloud in zip(poses, clouds, strict=True)]
    hit = np.floor(np.concatenate(ends) / CONFIG.occupancy.resolution_m).astype(np.int64)
    cells = np.unique(np.concatenate([rng.integers(-40, 40, (4000, 3)), hit]), axis=0)
    observations = np.stack(
        list(FrameObservations(CONFIG.occupancy, poses, rays.__getitem__).at(pack_keys(cells)))
    )
    assert len(observations) == len(poses)
    assert min((observations == sign).sum() for sign in (-1, 0, 1)) > 100
    for T, cloud, look in zip(poses, rays, observations, strict=True):
        builder = OccupancyBuilder(CONFIG.occupancy, np.eye(4))
        builder.integrate(cloud.cloud(), T)
        seen = replace(builder.part(), points=None).voxels(CONFIG.occupancy.resolution_m)
        assert np.abs(seen.log_odds).max() < log_odds(MAX_PROBABILITY)  # one frame clamps nothing
        known = dict(zip(pack_keys(seen.keys).tolist(), np.sign(seen.log_odds), strict=True))
        assert [known.get(key, 0) for key in pack_keys(cells).tolist()] == look.tolist()


def test_frames_that_are_too_far_away_or_look_elsewhere_are_not_read():
    poses, clouds = _poses_and_clouds(2)
    poses[0] = np.eye(4)
    poses[1] = make_transform(np.eye(3), np.array([0.0, 0.0, 60.0]))
    rays = [thin_rays(cloud, CONFIG.occupancy) for cloud in clouds]
    read: list[int] = []

    def reading(number: int) -> object:
        read.append(number)
        return rays[number]

    ahead = pack_keys(np.array([[0, 0, 40]]))
    assert len(list(FrameObservations(CONFIG.occupancy, poses, reading).at(ahead))) == 1
    assert read == [0]
    behind = pack_keys(np.array([[0, 0, -40]]))
    assert not list(FrameObservations(CONFIG.occupancy, poses, reading).at(behind))
