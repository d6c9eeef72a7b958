"""What another surface replaced within the reach of what is the same, on made points."""

import numpy as np
import pytest

from recon.core.values import PointCloud
from recon.map.changes.displaced import find_displaced, least_displaced

CELL_M, VOXEL_M = 0.2, 0.1
ERROR_M = 0.005
LEAVES = (8.0, 12.0)  # along the street, of a hedge that no two days see alike


def plane(rng: np.random.Generator, low: list[float], high: list[float], axis: int) -> np.ndarray:
    """Points of a plane across an axis, one a voxel, with an error along that axis."""
    sides = [np.arange(a, b, VOXEL_M) for a, b in zip(low, high, strict=True)]
    sides[axis] = np.array([low[axis]])
    xyz = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    xyz = xyz + rng.uniform(-0.03, 0.03, xyz.shape) * (np.arange(3) != axis)
    xyz[:, axis] += rng.normal(0.0, ERROR_M, len(xyz))
    return xyz


def street(day: int, side_m: float, drift_m: float = 0.0) -> PointCloud:
    """A road, a wall, a hedge, and the side of something that is parked at so many metres."""
    rng = np.random.default_rng(day)
    hedge = rng.uniform([LEAVES[0], 3.0, 0.2], [LEAVES[1], 3.6, 1.5], (1500, 3))
    parts = [
        plane(rng, [0, -3, 0], [20, 6, 0], 2),
        plane(rng, [0, 6, 0], [20, 6, 4], 1),
        plane(rng, [2, side_m, 0.3], [6, 0, 1.5], 1),
        hedge,
    ]
    xyz = np.concatenate(parts) + np.array([0, drift_m, 0])
    return PointCloud(xyz.astype(np.float32), frame="map")


def parked(cloud: PointCloud) -> np.ndarray:
    x, y, z = cloud.xyz.T
    return (x > 1.9) & (x < 6.1) & (y > 1.5) & (y < 2.5) & (z > 0.25)


class TestFindDisplaced:
    def test_a_side_that_stands_elsewhere_is_found_on_both_days_and_nothing_else(self):
        days = street(0, 2.0), street(1, 2.12, drift_m=0.005)
        for cloud, found in zip(days, find_displaced(*days, CELL_M), strict=True):
            assert found[parked(cloud)].mean() > 0.7
            assert not found[~parked(cloud)].any()

    @pytest.mark.parametrize("seed", range(5))
    def test_error_leaves_and_drift_displace_nothing(self, seed):
        days = street(2 * seed, 2.0), street(2 * seed + 1, 2.0, drift_m=0.02)
        for found in find_displaced(*days, CELL_M):
            assert not found.any()

    def test_a_day_without_points_and_one_that_is_the_same(self):
        none, cloud = PointCloud(np.zeros((0, 3), np.float32), frame="map"), street(0, 2.0)
        for days in ((none, cloud), (cloud, none), (cloud, cloud)):
            found = find_displaced(*days, CELL_M)
            assert [len(one) for one in found] == [len(day) for day in days]
            assert not any(one.any() for one in found)


class TestLeastDisplaced:
    def test_large_pieces_do_not_hide_themselves(self):
        sizes = np.array([1] * 20 + [2] * 10 + [3] * 5)
        least = least_displaced(sizes)
        assert 10 <= least < 20
        assert least_displaced(np.append(sizes, [60, 80])) == least

    def test_of_larger_pieces_by_chance_it_takes_more(self):
        few, many = (np.random.default_rng(0).geometric(p, 100) for p in (0.6, 0.35))
        assert least_displaced(few) < least_displaced(many)

    def test_chance_makes_no_object(self):
        rng = np.random.default_rng(1)
        maps = [rng.geometric(0.45, 80) for _ in range(100)]
        assert sum((sizes >= least_displaced(sizes)).any() for sizes in maps) <= 3

    def test_nothing_is_known_of_no_pieces(self):
        assert least_displaced(np.zeros(0, np.int64)) == 10
