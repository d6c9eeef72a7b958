"""A street depends on its settings alone; its images and truth agree with analytic geometry."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import SettingsError
from recon.core.geometry import se3
from recon.core.geometry.se3 import check_rigid
from recon.core.values import OCCUPIED
from recon.core.values.camera import project, unproject
from recon.street import materials, shapes
from recon.street.path import LANE_M, R_STREET_LEVEL, camera_poses, centre_line
from recon.street.render import StreetCamera, make_stage
from recon.street.settings import CORNER_M, StreetScene
from recon.street.street import StreetWorld, build_street, rig
from recon.street.truth import true_occupancy, true_surface

MIRROR = shapes.Material.MIRROR
SMALL = StreetScene(seed=3, frames=4, width_px=320, height_px=120, focal_px=180.0, noise_dn=0.0)


@pytest.fixture(scope="module")
def street():
    return StreetCamera(build_street(SMALL))


@pytest.fixture(scope="module")
def box_world():
    """A level road, a wall 20 m ahead, a box of 2 × 2 × 1.8 m whose front is 8 m ahead."""
    size = {"width_px": 200, "height_px": 100, "focal_px": 100.0, "baseline_m": 0.5}
    settings = StreetScene(frames=1, noise_dn=0.0, **size)
    grey = shapes.Paint(shapes.Material.PLAIN, (0.5, 0.5, 0.5), 1)
    soup = shapes.merge([
        shapes.quads([-5, -50, 0], [100, 0, 0], [0, 100, 0], grey),
        shapes.quads([20, -50, 0], [0, 100, 0], [0, 0, 30], grey),
        shapes.boxes([8, -1, 0.01], [10, 1, 1.8], grey),
    ])  # fmt: skip
    pose = se3.make_transform(R_STREET_LEVEL, np.array([0.0, 0.0, 1.5]))
    return StreetWorld(settings, soup, rig(settings), pose[None], np.array([0.0, 0.0, 1.0]))


@pytest.fixture(scope="module")
def frame(street):
    return street.render(1)


def _points(depth_m: np.ndarray, camera) -> np.ndarray:
    """float64 (H·W, 3), camera axes; NaN = sky."""
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    return unproject(u.ravel(), v.ravel(), depth_m.ravel().astype(np.float64), camera)


def _depths_at(street: StreetCamera, index: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points a frame shows, in its axes, and the depth that it sees there."""
    camera, view = street.world.camera, street.views(index)[0]
    u, v, _ = project(xyz, camera)
    inside = (u > 0) & (u < camera.width_px - 1) & (v > 0) & (v < camera.height_px - 1)
    pixels = np.stack([u[inside], v[inside]], axis=1)
    return inside, street.stage.depth(view.origin, view.directions(pixels))


def test_images_are_well_exposed_and_depth_is_that_of_the_road_the_sky_and_the_disparity(
    frame, street
):
    for image in (frame.pair.left, frame.pair.right):
        assert image.shape == (120, 320, 3)
        assert 70 < image.mean() < 180
        assert image.std() > 35
        assert (image == 255).mean() < 0.1
    xyz = _points(frame.depth_m, street.world.camera)
    height = xyz @ frame.ground_plane[:3] + frame.ground_plane[3]
    height = height[np.isfinite(height)]
    assert (np.abs(height) < 1e-4).mean() > 0.15
    assert (np.abs(height - 0.12) < 1e-4).mean() > 0.01  # the pavement
    # Nothing is below the road; float32 depths of 30 m are good to 2e-6 m.
    assert height.min() > -1e-4
    camera, sky = street.world.camera, np.isnan(frame.depth_m)
    product = (frame.truth.values * frame.depth_m)[~sky]
    assert np.allclose(product, camera.focal_px * camera.baseline_m)
    assert 0.02 < sky.mean() < 0.5
    assert np.array_equal(sky, np.isnan(frame.truth.values))
    assert not frame.truth.nonocc[sky].any()
    # It is blue or white but where an edge blends with a roof, and above the road.
    red, _, blue = frame.pair.left[sky].astype(int).T
    assert (blue >= red).mean() > 0.95
    assert not sky[80:].any()


def test_depth_and_occlusion_of_the_box_world_are_those_on_paper(box_world):
    depth = StreetCamera(box_world).depth(0)
    v, u = np.mgrid[0:100, 0:200]
    # Camera 1.5 m above the road, f = 100 px, principal point (99.5, 49.5).
    road = np.where(v > 49.5, 100.0 * 1.5 / np.where(v > 49.5, v - 49.5, 1), np.inf)
    expected = np.minimum(road, 20.0)
    x, y = (u - 99.5) * 8 / 100, (v - 49.5) * 8 / 100
    front = (np.abs(x) < 1.0) & (y > -0.3) & (y < 1.49)
    top = (v == 49) | (v == 48)
    expected[front] = 8.0
    certain = ~top & (np.abs(np.abs(x) - 1.0) > 0.2)
    # Corners are stored in single precision: 1e-6 m at these distances.
    np.testing.assert_allclose(depth[certain], expected[certain], rtol=3e-6)
    truth = StreetCamera(box_world).disparity_truth(0)
    # Row 48, 0.12 m above the cameras' height, looks over the road at box (8 m) and wall (20 m).
    row, d = truth.nonocc[48], truth.values[48]
    box = np.flatnonzero(d > 6.0)
    assert np.allclose(d[box], 100 * 0.5 / 8.0)
    assert np.allclose(np.delete(d, box), 100 * 0.5 / 20.0)
    # The box's left edge is at x = -1 m: column 99.5 - 12.5 = 87 in the left view, 80.75 in the
    # right one, where the wall appears 2.5 px further right than in the left view: 83.25.
    hidden = np.flatnonzero(~row[box[0] - 10 : box[0]]) + box[0] - 10
    assert box[0] == 87
    assert hidden.tolist() == [84, 85, 86]
    # Columns whose point lies left of the right image (beyond half a pixel): u < 2.
    assert row[:4].tolist() == [False, False, True, True]
    assert row[box].all()


def test_the_other_view_and_the_next_frame_show_the_same_points(frame, street):
    d, keep = frame.truth.values, frame.truth.nonocc.copy()
    v, u = np.mgrid[0:120, 0:320].astype(np.float32)
    x = (u - np.nan_to_num(d)).astype(np.float32)
    fetched = cv2.remap(frame.pair.right.astype(np.float32), x, v, cv2.INTER_LANCZOS4)
    error = np.abs(fetched - frame.pair.left).mean(axis=2)[keep & (x > 3) & (x < 316)]
    # Most surfaces are smooth at this size; the tail are edges that both views blend differently.
    assert np.median(error) < 1.5
    assert np.percentile(error, 90) < 10.0
    # One pixel off is clearly worse: the truth is where the images agree.
    shifted = cv2.remap(frame.pair.right.astype(np.float32), x + 1, v, cv2.INTER_LANCZOS4)
    worse = np.abs(shifted - frame.pair.left).mean(axis=2)[keep & (x > 3) & (x < 316)]
    assert worse.mean() > 2.0 * error.mean()
    camera, here, there = street.world.camera, 0, 2
    poses = street.world.trajectory.T_world_camera
    xyz = _points(street.depth(here), camera)
    moved = se3.apply(se3.invert(poses[there]) @ poses[here], xyz[np.isfinite(xyz[:, 2])])
    inside, found = _depths_at(street, there, moved)
    # A ray to a point ends there or before it; poses and depths are good to float32.
    assert (found <= moved[inside, 2] * (1 + 1e-4) + 1e-3).mean() > 0.999
    assert np.isclose(found, moved[inside, 2], rtol=1e-5, atol=1e-4).mean() > 0.85


def test_threads_change_no_bit_and_a_longer_drive_goes_down_the_same_street(street):
    again = StreetCamera(build_street(SMALL.model_copy(update={"threads": 1})))
    one, other = street.render(2), again.render(2)
    assert np.array_equal(one.pair.left, other.pair.left)
    assert np.array_equal(one.pair.right, other.pair.right)
    assert np.array_equal(one.truth.values, other.truth.values, equal_nan=True)
    assert np.array_equal(one.truth.nonocc, other.truth.nonocc)
    longer = StreetCamera(build_street(SMALL.model_copy(update={"frames": 12})))
    here, there = street.depth(3), longer.depth(3)
    near = np.nan_to_num(here, nan=np.inf) < 60.0
    assert near.mean() > 0.5
    # On the edge between two triangles either may be hit: the same to rounding.
    np.testing.assert_allclose(here[near], there[near], rtol=1e-6)
    for index in (-1, 4):
        with pytest.raises(SettingsError, match="no such frame"):
            street.depth(index)


def test_noise_and_gain_change_images_but_not_truth(street):
    update = {"noise_dn": 3.0, "right_gain": 0.8, "right_offset_dn": 5.0}
    noisy = StreetCamera(
        dataclasses.replace(street.world, settings=SMALL.model_copy(update=update))
    )
    clean, frame = street.render(0), noisy.render(0)
    mid = (clean.pair.left > 30) & (clean.pair.left < 225)
    difference = frame.pair.left.astype(float) - clean.pair.left
    assert 2.8 < difference[mid].std() < 3.2
    bright = (clean.pair.right > 60) & (clean.pair.right < 225)
    expected = 0.8 * clean.pair.right[bright].astype(float) + 5.0
    assert np.abs((frame.pair.right[bright] - expected).mean()) < 0.2
    assert np.array_equal(frame.truth.values, clean.truth.values, equal_nan=True)
    assert np.array_equal(noisy.pair(0).left, frame.pair.left)
    other = noisy.pair(1).left.astype(float) - street.pair(1).left
    assert abs(np.corrcoef(difference[mid], other[mid])[0, 1]) < 0.05


@pytest.fixture(scope="module")
def surface(street):
    return true_surface(street, range_m=25.0, voxel_m=0.1)


def test_the_surface_is_what_the_camera_sees_thin_and_within_its_range(street, surface):
    assert surface.frame == "world"
    # World is the first camera, so points in its view are hit by rays through their projections.
    inside, found = _depths_at(street, 0, surface.xyz.astype(np.float64))
    z = surface.xyz[inside, 2]
    # float32 coordinates of 25 m are good to 1e-6 m; grazing rays magnify that.
    assert np.isclose(found, z, rtol=1e-4, atol=1e-3).mean() > 0.8
    assert (found > z * 1.0001 + 1e-3).mean() < 0.01
    cells = np.floor(surface.xyz / np.float32(0.1)).astype(int)
    assert len(np.unique(cells, axis=0)) == len(surface)
    assert len(surface) > 10_000
    xyz, plane = surface.xyz.astype(np.float64), street.world.ground_plane(0)
    height = xyz @ plane[:3] + plane[3]
    assert (np.abs(height) < 1e-3).mean() > 0.1
    assert height.min() > -1e-3
    last = street.world.trajectory.T_world_camera[-1]
    assert ((xyz - last[:3, 3]) @ last[:3, 2]).max() < 25.5


def test_the_ground_plan_of_a_box_is_that_on_paper_and_turns_with_the_map_axes(box_world):
    camera = StreetCamera(box_world)
    truth = true_occupancy(camera, resolution_m=0.25, band_m=(0.3, 2.0), range_m=30.0)
    grid = truth.grid
    rows, columns = np.indices(grid.cells.shape)
    x = grid.origin_m[0] + (columns + 0.5) * 0.25
    y = grid.origin_m[1] + (rows + 0.5) * 0.25
    # The map's origin is the camera, its axes here those of the street.
    certain = (np.abs(np.abs(y) - 1.0) > 0.25) & (np.abs(x - 8) > 0.25) & (np.abs(x - 10) > 0.25)
    certain &= np.abs(x - 20.0) > 0.25
    box = (x > 8) & (x < 10) & (np.abs(y) < 1)
    assert np.array_equal((grid.cells == OCCUPIED)[certain], box[certain])
    # The front of the box and the road before it are seen, what is behind it is not.
    assert truth.seen[(np.abs(x - 8.1) < 0.1) & (np.abs(y) < 0.9)].all()
    # Up to 5.5 m rows of pixels meet the road less than a cell apart: Z² / (f·h) = 0.2 m.
    assert truth.seen[(x > 3) & (x < 5.5) & (np.abs(y) < 0.9)].all()
    assert not truth.seen[(x > 10.5) & (x < 14) & (np.abs(y) < 0.5)].any()
    turn = se3.make_transform(se3.exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    plain = true_occupancy(camera, range_m=15.0)
    turned = true_occupancy(camera, range_m=15.0, T_map_world=turn @ box_world.T_map_world)
    above = true_occupancy(camera, range_m=15.0, band_m=(1.9, 2.5))
    one, two, none = ((t.grid.cells == OCCUPIED).sum() for t in (plain, turned, above))
    # A quarter turn maps cells to cells, but for rounding at their borders.
    assert abs(int(one) - int(two)) <= 0.2 * one
    assert turned.grid.cells.shape[0] == pytest.approx(plain.grid.cells.shape[1], abs=2)
    assert none == 0


def test_obstacles_are_where_surface_points_are_and_frames_count_how_often_they_were_seen(
    street, surface
):
    truth = true_occupancy(street, range_m=60.0)
    world = street.world
    xyz = surface.xyz.astype(np.float64)
    height = se3.apply(se3.invert(world.T_world_street), xyz)[:, 2]
    tall = se3.apply(world.T_map_world, xyz[(height > 0.35) & (height < 1.95)])
    cells = np.floor((tall[:, :2] - truth.grid.origin_m) / 0.2).astype(int)
    # Every visible point in the band is in an obstacle's cell, up to 5 cm between the level cuts.
    hit = truth.grid.cells[cells[:, 1], cells[:, 0]] == OCCUPIED
    assert hit.mean() > 0.97
    assert 0.02 < (truth.grid.cells == OCCUPIED).mean() < 0.4
    T = street.world.T_map_world
    truth = true_occupancy(street, range_m=15.0, least_frames=3)
    assert 0 <= truth.frames.min() < truth.frames.max() == len(street)
    once = true_occupancy(street, range_m=15.0, least_frames=1)
    assert 0 < truth.seen.sum() < once.seen.sum()
    # What is only seen from beyond the range is true, and counts for no frame.
    centres = (truth.keys + 0.5) * 0.2
    cameras = (T @ street.world.trajectory.T_world_camera)[:, :3, 3]
    nearest = np.linalg.norm(centres[:, None] - cameras, axis=2).min(axis=1)
    # Half the diagonal of a cell more or less.
    assert nearest[truth.frames > 0].max() < 15.0 + 0.18
    assert (truth.frames == 0).any()
    assert len(np.unique(truth.keys, axis=0)) == len(truth.keys)
    assert nearest.max() < 17.0 + 0.18


RAILS = {"path": "straight", "sway": 0.0, "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}


def _poses(**settings) -> np.ndarray:
    chosen = StreetScene(**settings)
    return camera_poses(chosen, centre_line(chosen, 200.0))


def test_on_rails_the_camera_moves_straight_ahead(street):
    trajectory = street.world.trajectory
    assert np.array_equal(trajectory.T_world_camera[0], np.eye(4))
    assert np.allclose(np.diff(trajectory.timestamps_s), 0.1)
    poses = _poses(frames=5, speed_m_per_frame=0.8, **RAILS)
    T_world_camera = se3.invert(poses[0]) @ poses
    assert np.allclose(T_world_camera[:, :3, :3], np.eye(3))
    assert np.allclose(T_world_camera[:, :3, 3], np.outer(np.arange(5) * 0.8, [0, 0, 1]))


@pytest.mark.parametrize(("angle", "axis"), [("yaw_deg", 1), ("pitch_deg", 2)])
def test_the_mounting_turns_the_view_by_its_angles(angle, axis):
    ahead = _poses(frames=1, **{**RAILS, angle: 10.0})[0, :3, 2]
    expected = np.cos(np.radians(10)) * np.eye(3)[0] - np.sin(np.radians(10)) * np.eye(3)[axis]
    assert np.allclose(ahead, expected)


def test_a_curved_street_turns_by_its_rate_and_steps_have_the_length_of_the_speed():
    poses = _poses(frames=101, turn_deg_per_100m=30.0, sway=0.0, yaw_deg=0.0)
    turned = np.degrees(se3.angle_rad(se3.invert(poses[0]) @ poses[-1]))
    # The winding adds at most 0.35 · 18 m of the rate: 1.9° at both ends.
    assert 26.0 < turned < 34.0
    assert poses[-1, 1, 3] > 5.0  # positive = to the left
    poses = _poses(frames=60, speed_m_per_frame=1.0)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    # The lane lies 1.55 m inside or outside of the centre line, whose curve is above 180 m.
    assert np.allclose(steps, 1.0, atol=0.02)
    for T in poses:
        check_rigid("pose", T)


def test_map_axes_look_along_the_first_view_and_nothing_stands_in_the_lane(street):
    world = street.world
    T_map_street = world.T_map_world @ world.T_world_street
    assert np.allclose(T_map_street[2, :3], [0, 0, 1])
    forward = world.T_map_world[:3, 2]
    assert forward[0] > 0.99
    assert forward[1] == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(world.T_map_world[:3, 3], 0.0)
    assert len(build_street(StreetScene(seed=4, frames=4)).soup) != len(world.soup)
    centres = world.soup.vertices.mean(axis=1)
    for pose in world.T_street_camera:
        near = np.linalg.norm(centres[:, :2] - pose[:2, 3], axis=1) < 0.9
        assert (centres[near, 2] < 0.05).all()


TINY = {"width_px": 96, "height_px": 40, "focal_px": 54.0, "smooth_edges": False}
ON_RAILS = {"sway": 0.0, "noise_dn": 0.0}
BLOCK_M = (80.0, 60.0)
LAP_M = 2 * sum(BLOCK_M) - 8 * CORNER_M + 2 * math.pi * CORNER_M


@pytest.fixture(scope="module")
def block():
    """A drive whose frame 100 stands where frame 0 stood, one lap later."""
    settings = StreetScene(
        path="block", block_m=BLOCK_M, frames=111, speed_m_per_frame=LAP_M / 100, **TINY, **ON_RAILS
    )
    return StreetCamera(build_street(settings))


def test_laps_around_a_block_are_the_same_and_nothing_stands_on_the_road(block):
    road = centre_line(StreetScene(path="block", block_m=BLOCK_M), 0.0)
    assert road.loop_m == pytest.approx(LAP_M)
    # Steps of 0.25 m replace each corner's arc by chords, all four alike.
    assert road.xy_m[-1] == pytest.approx(road.xy_m[0], abs=1e-9)
    assert road.heading_rad[-1] == pytest.approx(2 * math.pi)
    poses = block.world.T_street_camera
    assert poses[100:] == pytest.approx(poses[:11], abs=1e-9)
    # The car keeps to the outer lane, so a lap of the car is longer than one of the line.
    expected_m = LAP_M - 2 * math.pi * LANE_M
    assert block.world.trajectory.distances_m[100] == pytest.approx(expected_m, rel=0.005)
    assert np.array_equal(block.pair(3).left, block.pair(103).left)
    assert not np.array_equal(block.pair(3).left, block.pair(53).left)
    road = centre_line(block.world.settings, 0.0)
    corners = block.world.soup.vertices.reshape(-1, 3)
    standing = corners[(corners[:, 2] > 0.3) & (corners[:, 2] < 2.5), :2]
    gap = np.linalg.norm(standing[:, None] - road.xy_m[None, ::8], axis=2).min(axis=1)
    # Parked cars fill the outer 2 m of each side of the road.
    assert gap.min() > materials.ROAD_HALF_M - 2.3
    middle = road.loop_m - CORNER_M * math.pi / 4  # of the last corner
    inner = road.points(np.array([middle]), np.array([9.0]))[0]
    walls = corners[corners[:, 2] > 5.0, :2]
    assert np.linalg.norm(walls - inner, axis=1).min() > 2.0


def test_a_repeated_street_looks_and_is_the_same_each_period():
    period = {"path": "straight", "repeat_m": 40.0, "frames": 41, "speed_m_per_frame": 4.0}
    repeated = StreetCamera(build_street(StreetScene(**period, **TINY, **ON_RAILS)))
    here, later, elsewhere = (repeated.pair(k).left.astype(float) for k in (2, 12, 5))
    # Only the grain of the surfaces is of the place, and the end of the street comes nearer.
    assert np.abs(later - here).mean() < 0.3 * np.abs(elsewhere - here).mean()
    here, later = repeated.depth(2), repeated.depth(12)
    both = (here < 60.0) & (later < 60.0)
    assert both.mean() > 0.5
    assert np.allclose(here[both], later[both], atol=1e-4)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"frames": 0}, "frames"),
        ({"baseline_m": 0.0}, "baseline_m"),
        ({"colour": 1}, "colour"),
        ({"path": "block", "block_m": (100.0, 40.0)}, "block_m"),
        ({"path": "curve", "repeat_m": 40.0}, "repeat_m"),
    ],
)
def test_an_impossible_street_is_refused(values, words):
    with pytest.raises(SettingsError, match=words):
        StreetScene.parse(values)


def _weighed(values: np.ndarray) -> float:
    weights = np.random.default_rng(0).random(values.size)
    return float(weights @ values.ravel() / values.size)


@pytest.mark.parametrize(
    ("shape", "figures"),
    [
        ({}, [16.022485422, 0.003546223, 0.352370272, 0.164386557, 51.748, 47.441]),
        (
            {"path": "block", "block_m": (80.0, 60.0)},
            [9.605114471, 0.003257997, 0.652068615, 0.164711061, 53.947, 49.506],
        ),
        (
            {"path": "straight", "repeat_m": 40.0, "fences": True},
            [7.594344046, 0.00596996, 0.087696586, 0.151292417, 52.937, 48.734],
        ),
    ],
    ids=["curve", "block", "fences"],
)
def test_equal_settings_give_the_streets_and_images_that_they_gave_before(shape, figures):
    scene = StreetScene(frames=1, right_gain=0.9, right_offset_dn=3.0, **TINY, **shape)
    camera = StreetCamera(build_street(scene))
    soup, pair = camera.world.soup, camera.pair(0)
    parts = (soup.vertices, soup.normals, soup.uv, soup.rgb, pair.left, pair.right)
    # The table is rounded; a ray that grazes an edge may hit the other side of it.
    assert [_weighed(part) for part in parts[:4]] == pytest.approx(figures[:4], abs=5e-9)
    assert [_weighed(part) for part in parts[4:]] == pytest.approx(figures[4:], abs=0.05)


def test_a_mirror_shows_what_is_before_it_as_far_behind_it():
    wall, glass = (shapes.Paint(kind, part=1) for kind in (shapes.Material.BRICK, MIRROR))
    soup = shapes.merge([
        shapes.quads([3, -5, -5], [0, 10, 0], [0, 0, 10], glass),
        shapes.quads([-2, -5, -5], [0, 10, 0], [0, 0, 10], wall),
    ])  # fmt: skip
    stage, eye = make_stage(soup, np.array([0.0, 0.0, 1.0]), 0), np.zeros(3)
    ahead, back = np.array([[1.0, 0.1, 0.0]]), np.array([[-1.0, 0.4, 0.0]])
    assert stage.depth(eye, ahead) == pytest.approx(3.0 + 5.0)
    assert stage.depth(eye, ahead, in_mirrors=False) == pytest.approx(3.0)
    assert stage.look(eye, ahead, 0.01).label == stage.look(eye, back, 0.01).label


def test_a_room_is_that_of_its_seed_with_way_through_and_blurred_by_turns():
    size = {"width_px": 160, "height_px": 100, "focal_px": 90.0, "smooth_edges": False}
    scene = StreetScene(path="room", seed=5, frames=150, noise_dn=0.0, **size)
    room, again = (StreetCamera(build_street(scene)) for _ in range(2))
    sharp = StreetCamera(build_street(scene.model_copy(update={"shutter": 0.0})))
    images = [camera.pair(10).left for camera in (room, again, sharp)]
    np.testing.assert_array_equal(images[0], images[1])
    edges = [cv2.Laplacian(image, cv2.CV_64F).var() for image in images[1:]]
    assert 1.2 * edges[0] < edges[1]
    path = room.world.T_street_camera
    assert room.stage.rays.distance(path[:, :3, 3]).min() > 0.4
    assert np.abs(np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1) - 0.1).max() < 0.05
    assert (scene.baseline_m, scene.pitch_deg) == (0.12, 8.0)
    assert StreetScene(path="room", baseline_m=0.3).baseline_m == 0.3


@given(st.floats(-20, 20), st.floats(0.2, 5), st.floats(0.05, 0.95), st.floats(0.01, 9))
def test_stripes_are_the_mean_over_the_footprint(x, period, ratio, w):
    fine = x + w * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    expected = ((fine % period) < ratio * period).mean()
    got = materials.stripes(np.array([x]), period, ratio * period, np.array([w]))[0]
    # 4000 samples place each stripe's edge to w/4000; there are at most 2·(9 / 0.2 + 1) edges.
    assert got == pytest.approx(expected, abs=0.03)
