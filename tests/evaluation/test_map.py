"""Metrics of clouds and of occupancy maps, on truth that can be counted by hand, and ICP."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import EvaluationError, RegistrationError
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, make_transform
from recon.core.values import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyTruth,
    OccupancyVoxels,
    PointCloud,
    RectifiedCamera,
)
from recon.evaluation.map import evaluate_map, icp, nearest_distances
from recon.evaluation.occupancy import evaluate_occupancy
from recon.map.ground.axes import AXES_MAP_WORLD


def grid(offset_m: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(20) * 0.5, np.arange(20) * 0.5)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, offset_m)], axis=1).astype(np.float32)


def cloud(xyz: np.ndarray) -> PointCloud:
    return PointCloud(xyz.astype(np.float32))


def test_an_offset_is_the_median_and_decides_at_the_threshold():
    same = evaluate_map(cloud(grid()), cloud(grid()), 0.2)
    assert (same.precision, same.recall, same.f_score) == (1, 1, 1)
    # The distance of a point to itself, squared and rooted in single precision.
    assert 0 <= same.median_m <= same.p95_m < 1e-3
    assert (same.points, same.reference_points) == (400, 400)
    near = evaluate_map(cloud(grid(0.15)), cloud(grid()), 0.2)
    assert (near.median_m, near.p95_m) == pytest.approx((0.15, 0.15), abs=1e-4)
    assert near.f_score == 1
    far = evaluate_map(cloud(grid(0.25)), cloud(grid()), 0.2)
    assert (far.precision, far.recall, far.f_score) == (0, 0, 0)


def test_precision_and_recall_count_places_however_dense_or_far_away():
    clouds = cloud(np.concatenate([grid()[:240], grid(5.0)[:80]])), cloud(grid())
    there, back = evaluate_map(*clouds, 0.2), evaluate_map(*clouds[::-1], 0.2)
    assert (there.precision, there.recall) == pytest.approx((0.75, 0.6))
    assert (back.precision, back.recall) == pytest.approx((0.6, 0.75))
    assert there.f_score == back.f_score == pytest.approx(2 * 0.75 * 0.6 / 1.35)
    rng = np.random.default_rng(0)
    dense_wrong = rng.uniform([0, 0, 4], [0.05, 0.05, 4.05], (5000, 3))
    result = evaluate_map(cloud(np.concatenate([grid(), dense_wrong])), cloud(grid()), 0.2)
    assert result.precision >= 400 / 408  # the heap fills at most eight voxels
    far = np.array([4000.0, 0, 9000.0])
    here, there = ((grid(z) + far).astype(np.float32) for z in (0.125, 0.0))
    # float32 places points at 9 km to half a millimetre.
    np.testing.assert_allclose(nearest_distances(here, there), 0.125, atol=2e-3)


@pytest.mark.parametrize(
    ("estimate", "reference", "threshold_m", "complaint"),
    [
        (cloud(np.zeros((0, 3))), cloud(grid()), 0.2, "estimated cloud is empty"),
        (cloud(grid()), cloud(np.zeros((0, 3))), 0.2, "reference cloud is empty"),
        (cloud(grid()), PointCloud(grid(), frame="map"), 0.2, "different frames"),
        (cloud(grid()), grid(), 0.2, "PointCloud and ndarray"),
        (cloud(grid()), cloud(grid()), 0.0, "threshold is not positive"),
        (cloud(grid()), cloud(grid()), float("nan"), "threshold is not positive"),
    ],
)
def test_clouds_that_cannot_be_compared_are_refused(estimate, reference, threshold_m, complaint):
    with pytest.raises(EvaluationError, match=complaint):
        evaluate_map(estimate, reference, threshold_m)


def corner(seed: int) -> np.ndarray:
    """Points on three planes that meet at right angles."""
    sides = np.random.default_rng(seed).uniform(0, 10, (3, 3000, 3))
    for axis in range(3):
        sides[axis, :, axis] = 0
    return sides.reshape(-1, 3)


@pytest.mark.parametrize("away_m", [0.0, 5000.0])
def test_icp_finds_the_motion_between_two_samples_of_a_corner(away_m):
    here = np.eye(4)
    here[:3, 3] = away_m
    small = make_transform(exp_so3(np.array([0.01, -0.02, 0.015])), np.array([0.3, -0.2, 0.1]))
    T = here @ small @ invert(here)
    found, ratio = icp(apply(here, corner(0)), apply(T @ here, corner(1)), (2.0, 0.5, 0.2))
    wrong = invert(here) @ invert(T) @ found @ here
    # Random samples of planes: exact up to the normals at the edges of the corner.
    assert np.linalg.norm(wrong[:3, 3]) < 0.01
    assert angle_rad(wrong) < 1e-3
    assert ratio > 0.9


def test_clouds_and_occupancies_that_cannot_be_compared_are_reported():
    with pytest.raises(RegistrationError, match="no corresponding points"):
        icp(corner(0), corner(1) + 100, (2.0, 0.5))
    xyz = corner(2)
    xyz.flags.writeable = False
    assert icp(xyz, xyz, (1.0,))[1] == 1.0
    coarse = OccupancyGrid(np.zeros((2, 2), np.int8), 0.4, (0.0, 0.0))
    with pytest.raises(EvaluationError, match="different resolutions"):
        evaluate_occupancy(voxels(WALL), coarse, TRUTH)
    with pytest.raises(EvaluationError, match="no surface was seen in enough frames"):
        evaluate_occupancy(voxels(WALL), TRUTH.grid, seen(frames=2))


EDGE_M = 0.2
WALL = np.array([(50, j, k) for j in range(-6, 6) for k in range(-3, 3)], np.int32)
CELLS = np.full((20, 60), FREE, np.int8)
CELLS[4:16, 50] = OCCUPIED


def seen(frames: int = 3) -> OccupancyTruth:
    """A wall 10 m ahead, in view of a camera that stands still; a grid with its footprint."""
    pose = np.eye(4)
    pose[:3, :3] = AXES_MAP_WORLD
    return OccupancyTruth(
        grid=OccupancyGrid(CELLS, EDGE_M, (0.0, -2.0)),
        seen=np.ones(CELLS.shape, dtype=np.bool_),
        keys=WALL,
        frames=np.full(len(WALL), frames, np.int32),
        # Half as wide as far: sees 10 m to each side at 20 m.
        camera=RectifiedCamera(100.0, 49.5, 49.5, 49.5, 0.5, 100, 100),
        T_map_camera=np.tile(pose, (frames, 1, 1)),
        range_m=20.0,
        least_frames=3,
    )


TRUTH = seen()


def voxels(*occupied: np.ndarray, free: np.ndarray = WALL[:0]) -> OccupancyVoxels:
    keys = np.concatenate([*occupied, free]).astype(np.int32)
    log_odds = np.full(len(keys), 2.0, np.float32)
    log_odds[len(keys) - len(free) :] = -2.0
    return OccupancyVoxels(keys, log_odds, EDGE_M)


@pytest.mark.parametrize(("shift", "exact", "tolerant"), [(1, 0.0, 1.0), (2, 0.0, 0.0)])
def test_the_tolerance_is_one_cell(shift, exact, tolerant):
    moved = OccupancyGrid(np.roll(CELLS, shift, axis=1), EDGE_M, (0.0, -2.0))
    found = evaluate_occupancy(voxels(WALL + np.array([shift, 0, 0])), moved, TRUTH)
    assert (found.voxels_exact.precision, found.voxels_exact.recall) == (exact, exact)
    assert (found.voxels.precision, found.voxels.recall) == (tolerant, tolerant)
    assert (found.grid_exact.iou_occupied, found.grid.iou_occupied) == (exact, tolerant)


def test_voxels_count_that_images_held_and_true_ones_that_were_seen_often():
    beside, behind, far = (WALL + np.array(by) for by in ([0, 80, 0], [-100, 0, 0], [60, 0, 0]))
    found = evaluate_occupancy(voxels(WALL, beside, behind, far), TRUTH.grid, TRUTH)
    assert (found.voxels.precision, found.voxels.voxels) == (1.0, 72)
    # What is invented behind a wall is wrong.
    found = evaluate_occupancy(voxels(WALL, WALL + np.array([6, 0, 0])), TRUTH.grid, TRUTH)
    assert (found.voxels.precision, found.voxels.recall) == (0.5, 1.0)
    frames = np.where(WALL[:, 1] < 0, 3, 2).astype(np.int32)
    seldom = replace(TRUTH, frames=frames)
    half = evaluate_occupancy(voxels(WALL[WALL[:, 1] < 0]), TRUTH.grid, seldom)
    assert (half.voxels.true_voxels, half.voxels.recall) == (len(WALL) / 2, 1.0)
    # A surface that was seen once is a surface nevertheless.
    assert evaluate_occupancy(voxels(WALL), TRUTH.grid, seldom).voxels.precision == 1.0


def test_intersection_over_union_on_paper_counts_seen_cells_wherever_the_grid_lies():
    cells = np.full((20, 60), FREE, np.int8)
    cells[4:10, 50] = OCCUPIED  # 6 of 12 found
    cells[10:12, 50] = UNKNOWN  # 2 not known, so 4 are called free
    cells[4:10, 20] = OCCUPIED  # 6 invented
    found = evaluate_occupancy(voxels(WALL), OccupancyGrid(cells, EDGE_M, (0.0, -2.0)), TRUTH)
    assert found.grid_exact.iou_occupied == pytest.approx(6 / 18)
    # Free in both: all but 12 true, 6 invented. In either: all but 12 true, and 4 called free.
    assert found.grid_exact.iou_free == pytest.approx((1200 - 18) / (1200 - 12 + 4))
    assert found.grid_exact.occupied_called_free == pytest.approx(4 / 12)
    assert found.grid_exact.unknown == pytest.approx(2 / 1200)
    # Within one cell, a seventh true cell is found.
    assert found.grid.iou_occupied == pytest.approx(7 / 18)
    ahead = np.zeros_like(TRUTH.seen)
    ahead[:, 40:60] = True
    part = OccupancyGrid(CELLS[:, 45:], EDGE_M, (9.0, -2.0))
    found = evaluate_occupancy(voxels(WALL), part, replace(TRUTH, seen=ahead)).grid_exact
    assert (found.iou_occupied, found.unknown, found.cells) == pytest.approx((1.0, 5 / 20, 400))
