"""Ground truth of a drive: visible surfaces and the footprint of obstacles."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.core.geometry.projection import project
from recon.core.values import OCCUPIED, PointCloud
from recon.street.render import StreetCamera
from recon.street.truth import true_occupancy, true_surface


@pytest.fixture(scope="module")
def surface(street) -> PointCloud:
    return true_surface(street, range_m=25.0, voxel_m=0.1)


def test_surface_points_lie_on_what_the_camera_sees(street, surface):
    assert surface.frame == "world"
    # World is the first camera, so points in its view are hit by rays through their projections.
    u, v, _ = project(surface.xyz.astype(np.float64), street.world.camera)
    inside = (u > 0) & (u < 319) & (v > 0) & (v < 119)
    view = street.views(0)[0]
    found = street.stage.depth(view.origin, view.directions(np.stack([u, v], axis=1)[inside]))
    z = surface.xyz[inside, 2]
    # float32 coordinates of 25 m are good to 1e-6 m; grazing rays magnify that.
    on_surface = np.isclose(found, z, rtol=1e-4, atol=1e-3)
    assert on_surface.mean() > 0.8
    assert (found > z * 1.0001 + 1e-3).mean() < 0.01


def test_the_surface_has_one_point_per_voxel(surface):
    cells = np.floor(surface.xyz / np.float32(0.1)).astype(int)
    assert len(np.unique(cells, axis=0)) == len(surface)
    assert len(surface) > 10_000


def test_the_surface_of_the_road_is_at_the_height_of_the_road(street, surface):
    plane = street.world.ground_plane(0)
    height = surface.xyz.astype(np.float64) @ plane[:3] + plane[3]
    assert (np.abs(height) < 1e-3).mean() > 0.1
    assert height.min() > -1e-3


def test_the_surface_stays_within_its_range(street, surface):
    centres = street.world.trajectory.positions_m
    forward = surface.xyz.astype(np.float64) @ street.world.trajectory.T_world_camera[-1][:3, 2]
    assert forward.max() < centres[-1] @ street.world.trajectory.T_world_camera[-1][:3, 2] + 25.5


def test_the_ground_plan_of_a_box_is_that_on_paper(box_world):
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


def test_what_is_above_or_below_the_band_is_no_obstacle(box_world):
    above = true_occupancy(StreetCamera(box_world), range_m=15.0, band_m=(1.9, 2.5))
    assert not (above.grid.cells == OCCUPIED).any()


def test_the_grid_turns_with_the_map_axes(box_world):
    camera = StreetCamera(box_world)
    turn = se3.make_transform(se3.exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    plain = true_occupancy(camera, range_m=15.0)
    turned = true_occupancy(camera, range_m=15.0, T_map_world=turn @ box_world.T_map_world)
    one, two = ((t.grid.cells == OCCUPIED).sum() for t in (plain, turned))
    # A quarter turn maps cells to cells, but for rounding at their borders.
    assert abs(int(one) - int(two)) <= 0.2 * one
    assert turned.grid.cells.shape[0] == pytest.approx(plain.grid.cells.shape[1], abs=2)


def test_seen_obstacles_of_the_street_are_where_surface_points_are(street, surface):
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


def test_frames_count_how_often_a_cell_was_seen(street):
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
