"""What leaves a place before a plain wall is gone after as many looks as rays would take."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import recon
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import (
    OCCUPIED,
    OccupancyVoxels,
    RayCloud,
    RectifiedCamera,
    StereoPair,
    join_clouds,
    join_voxels,
)
from recon.core.values.arrays import Bool, Float64
from recon.export.occupancy import Flattening
from recon.map.drive.sequence import MappedSequence, map_sequence
from recon.map.occupancy.gone import CELL_PX, find_gone, texture_of
from recon.street.path import R_STREET_LEVEL
from recon.street.render import Stage, make_stage, stereo_views, take_image
from recon.street.shapes import Material, Paint, boxes, merge, quads
from tests.scenery.film import Film

CAMERA = RectifiedCamera(300.0, 159.5, 99.5, 159.5, 0.12, 320, 200)
ROWS, COLUMNS = 200 // CELL_PX, 320 // CELL_PX
HERE = OccupancyVoxels(np.array([[0, 0, 20]], np.int32), np.array([3.0], np.float32), 0.1)
THERE_M = HERE.centres_m[0]  # 2 m ahead of a camera in the origin
AT = np.array(divmod(int(99.5 + 300 * 0.05 / 2.05), CELL_PX))[0]
View = tuple[RayCloud, Float64, RectifiedCamera]


def view(
    depths_m: Sequence[float] = (), texture: int = 1, T: Float64 | None = None, aside: int = 0
) -> View:
    """A look with rays of some depths towards the voxel, or some squares aside, and far walls."""
    T = np.eye(4) if T is None else T
    far = np.array([[x, 1.5, 4.0] for x in np.linspace(-2, 2, 30)])
    toward = apply(invert(T), THERE_M[None])[0]
    toward = toward / toward[2] + np.array([aside * CELL_PX / 300.0, 0.0, 0.0])
    xyz = np.concatenate([far, *(depth * toward[None] for depth in depths_m)])
    ones = np.ones(len(xyz), np.uint8)
    values = np.full((ROWS, COLUMNS), texture, np.uint8)
    values[-6:] = 60  # of what the far rays hit, and of the next row
    values[:2] = 1
    places = np.rint(xyz / 0.001).astype(np.int16)
    rays = RayCloud(places, np.full(len(xyz), 0.005, np.float16), 255 * ones, ones, 0.001, values)
    return rays, T, CAMERA


HIT, PLAIN = view([THERE_M[2]], 40), view()


def gone(views: Sequence[View]) -> bool:
    return bool(find_gone(HERE, views)[0])


def test_what_was_certain_is_gone_after_nine_looks_and_seen_again_it_is_back():
    assert not gone([HIT] * 10)
    assert not gone([HIT] * 10 + [PLAIN] * 8)
    assert gone([HIT] * 10 + [PLAIN] * 9)
    assert not gone([HIT] * 10 + [PLAIN] * 6 + [HIT] + [PLAIN] * 4)
    assert gone([HIT] * 10 + [PLAIN] * 6 + [HIT] + [PLAIN] * 5)
    assert not gone([HIT] * 10 + [PLAIN] * 20 + [HIT] * 3)
    # What was hit once: three, never one.
    assert not gone([HIT, PLAIN, PLAIN])
    assert gone([HIT, *[PLAIN] * 3])
    # What nobody hit did not leave.
    assert not gone([PLAIN] * 20)


def turned(distance_m: float, angle_deg: float) -> Float64:
    """A pose from which the voxel is so far ahead, after a turn around it."""
    R = exp_so3(np.array([0.0, np.radians(angle_deg), 0.0]))
    return make_transform(R, THERE_M - R @ np.array([0.0, 0.0, distance_m]))


BEFORE = 0.6 * THERE_M[2]


@pytest.mark.parametrize(
    ("look", "left"),
    [
        (view(texture=19), True), (view(texture=30), False),
        # A thing with its own edges before it: where it is, or to both sides.
        (view([BEFORE], 19), False), (view([BEFORE], 19, aside=1), False),
        (view([BEFORE], 19, aside=12), False), (view([2 * THERE_M[2]], 19, aside=12), True),
        # From elsewhere the same surface may look plain.
        (view(T=turned(2.6, 0)), True), (view(T=turned(3.2, 0)), False),
        (view(T=turned(1.2, 0)), False), (view(T=turned(2.05, 20)), True),
        (view(T=turned(2.05, 40)), False), (view(T=turned(-2.0, 0)), False),
        # Without texture, and where rectification left no image.
        ((replace(PLAIN[0], texture=np.zeros((0, 0), np.uint8)), *PLAIN[1:]), False),
        (view(texture=255), False),
    ],
)  # fmt: skip
def test_a_look_counts_where_the_surface_would_show_and_nothing_hides_it(look, left):
    assert gone([HIT] * 10 + [look] * 30) == left


def test_what_is_matched_as_seldom_as_before_stays():
    seldom = [HIT, view(texture=40), view(texture=40), view(texture=40)] * 10
    assert not gone([*seldom, *[view(texture=40)] * 50])


def test_texture_is_the_mean_gradient_of_squares_that_are_all_image():
    ramp = np.tile(np.arange(0, 80, 2, dtype=np.uint8), (20, 1))  # 2 grey levels per pixel
    found = texture_of(ramp, None)
    assert found.shape == (2, 5)
    assert (found[:, 1:-1] == 8).all()
    assert not texture_of(np.full((20, 40), 200, np.uint8), None).any()
    valid = np.ones(ramp.shape, bool)
    valid[3, 9] = False
    assert (texture_of(ramp, valid) == 255).sum() == 1
    assert texture_of(np.zeros((5, 90), np.uint8), None).size == 0


THING = np.array([[2.4, -0.3, 0.0], [2.8, 0.3, 1.0]])


@cache
def stage(thing: Material | None) -> Stage:
    """A plain wall at 3.6 m with something before it, and posts on both sides."""
    parts = [
        quads([-10.0, -10.0, 0.0], [20, 0, 0], [0, 20, 0], Paint(Material.PAVING, part=1)),
        boxes([3.6, -6, 0], [3.8, 6, 3.0], Paint(Material.WHITE, (0.9, 0.9, 0.9), 2)),
        boxes([3.0, -1.6, 0], [3.6, -1.2, 1.4], Paint(Material.BRICK, (0.5, 0.4, 0.3), 4)),
        boxes([3.0, 1.3, 0], [3.6, 1.7, 1.1], Paint(Material.LEAVES, (0.3, 0.4, 0.2), 5)),
    ]
    if thing is not None:
        parts.append(boxes(*THING, Paint(thing, (0.5, 0.3, 0.2), 3)))
    return make_stage(merge(parts), np.array([-0.5, 0.3, 0.81]), 0)


def film(things: Sequence[Material | None], dark_from: int = 99) -> Film:
    rng, pairs, poses = np.random.default_rng(0), [], []
    for frame, thing in enumerate(things):
        R = R_STREET_LEVEL @ exp_so3(np.array([-0.15, 0.0, 0.0]))
        poses.append(make_transform(R, np.array([0.0, 0.2 * np.sin(0.3 * frame), 1.0])))
        images = []
        for one in stereo_views(CAMERA, poses[-1]):
            light = take_image(stage(thing), one, smooth_edges=False)
            light = light * (0.4 if frame >= dark_from else 1.0)
            noisy = 255 * light + rng.standard_normal(light.shape)
            images.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
        pairs.append(StereoPair(*images))
    return Film(pairs, CAMERA, invert(poses[0]) @ np.stack(poses))


def mapped(drive: Film, *, remove: bool = True) -> MappedSequence:
    changes = {"scene.scale": 0.2, "ground.camera_height_m": 1.0, "grid.min_height_m": 0.15}
    config = recon.load_config(None, changes | {"fusion.remove_moving": remove}).at_scale(0.2)
    return map_sequence(drive, config, known_poses=drive.trajectory)


def inside(made: MappedSequence, xyz: Float64) -> Bool:
    """Return which places of the map are where the thing stands, above the ground."""
    first = make_transform(
        R_STREET_LEVEL @ exp_so3(np.array([-0.15, 0.0, 0.0])), np.array([0.0, 0.0, 1.0])
    )
    there = apply(first @ invert(made.T_map_world), xyz)
    low, high = THING + np.array([[-0.06, -0.06, 0.15], [0.06, 0.06, 0.06]])
    return np.asarray(((there > low) & (there < high)).all(axis=1))


def figures(made: MappedSequence) -> tuple[int, int, int]:
    """Occupied voxels, cells of the grid, and points of the cloud where the thing stood."""
    voxels = join_voxels((tile.voxels for tile in made.tiles), made.tiles.resolution_m)
    occupied = voxels.centres_m[voxels.log_odds > 0]
    grid, _, _ = Flattening(made.placed).grid()
    row, column = np.nonzero(grid.cells == OCCUPIED)
    xy = (np.stack([column, row], axis=1) + 0.5) * grid.resolution_m + grid.origin_m
    at = np.pad(xy, ((0, 0), (0, 1)), constant_values=-0.5)
    cloud = join_clouds(tile.cloud for tile in made.tiles).xyz
    return tuple(int(inside(made, one.astype(float)).sum()) for one in (occupied, at, cloud))


BRICK, WEAK = Material.BRICK, Material.CAR_PAINT


@pytest.mark.slow
def test_a_thing_before_a_plain_wall_that_leaves_is_gone_after_nine_frames_and_not_before():
    drive = film([BRICK] * 10 + [None] * 14)
    voxels, cells, points = figures(mapped(drive.taken(slice(0, 15))))
    assert voxels > 500
    assert cells > 30
    assert points > 1000
    left = figures(mapped(drive))
    assert left[0] < 0.15 * voxels
    assert left[1] == 0
    assert left[2] < 0.15 * points
    assert figures(mapped(drive, remove=False))[1] > 15  # rays alone do not tell


@pytest.mark.slow
@pytest.mark.parametrize(("thing", "dark_from"), [(BRICK, 99), (WEAK, 99), (BRICK, 8)])
def test_what_stays_stays_also_if_it_is_nearly_plain_or_it_gets_dark(thing, dark_from):
    drive = film([thing] * 22, dark_from)
    assert figures(mapped(drive)) == figures(mapped(drive, remove=False))


@pytest.mark.slow
def test_maps_without_textures_are_as_before(monkeypatch):
    monkeypatch.setattr(
        "recon.map.drive.drive.texture_of", lambda image, valid: np.zeros((0, 0), np.uint8)
    )
    drive = film([BRICK] * 6 + [None] * 10)
    assert figures(mapped(drive))[:2] == figures(mapped(drive, remove=False))[:2]
