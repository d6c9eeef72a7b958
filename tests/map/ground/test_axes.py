"""Map axes of known points, and the ground below a tilted camera."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.core.geometry.se3 import apply, exp_so3
from recon.core.values import PointCloud
from recon.map.ground.axes import AxesSettings, estimate_ground, map_axes

SETTINGS = AxesSettings()


def _street(pitch_deg: float, roll_deg: float = 0.0, height: float = 1.5) -> PointCloud:
    """Ground, a wall to the right and a box, seen by a tilted camera; camera axes."""
    rng = np.random.default_rng(0)
    ground = np.stack([rng.uniform(-4, 4, 6000), np.full(6000, height), rng.uniform(3, 18, 6000)])
    wall = np.stack([np.full(5000, 4.0), rng.uniform(-3, height, 5000), rng.uniform(3, 18, 5000)])
    box = np.stack([rng.uniform(-1, 1, 2000), rng.uniform(0.7, 0.7, 2000), rng.uniform(7, 9, 2000)])
    xyz = np.hstack([ground, wall, box]).T + rng.normal(0, 0.01, (13_000, 3))
    # Camera pitched down: the ground rises in its image.
    turn = exp_so3(np.array([math.radians(-pitch_deg), 0, math.radians(roll_deg)]))
    return PointCloud((xyz @ turn.T).astype(np.float32))


def test_map_axes_are_forward_left_up() -> None:
    T = map_axes(None, SETTINGS)
    right_down_forward = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    assert apply(T, right_down_forward).tolist() == [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (2.0, -1.0), (12.0, 0.0), (-8.0, 6.0)])
def test_the_ground_is_found_among_walls_and_boxes(pitch: float, roll: float) -> None:
    plane = estimate_ground(_street(pitch, roll))
    # 6000 points with 1 cm of noise fix a plane much better than this.
    assert plane.height_m == pytest.approx(1.5, abs=0.01)
    assert plane.tilt_deg == pytest.approx(math.hypot(pitch, roll), abs=0.1)
    assert plane.inliers > 5000
    np.testing.assert_array_equal(plane.normal, estimate_ground(_street(pitch, roll)).normal)
    exact = np.array_equal(map_axes(plane, SETTINGS), map_axes(None, SETTINGS))
    assert exact == (math.hypot(pitch, roll) < 3)


def test_walls_ceilings_and_nothing_are_no_ground() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-5, 5, 8000), rng.uniform(-2, 2, 8000)
    wall = np.stack([x, y, np.full(8000, 6.0)], 1)
    ceiling = np.stack([x, np.full(8000, -1.5), rng.uniform(4, 15, 8000)], 1)
    for xyz in (wall, ceiling, np.zeros((0, 3))):
        assert estimate_ground(PointCloud(xyz.astype(np.float32))) is None


@pytest.mark.parametrize(("pitch", "roll"), [(12.0, 0.0), (-10.0, 5.0)])
def test_large_tilts_are_levelled(pitch: float, roll: float) -> None:
    street = _street(pitch, roll)
    T = map_axes(estimate_ground(street), SETTINGS)
    ground = apply(T, street.xyz[:6000].astype(np.float64))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    # Noise of the points is 1 cm; a degree that was left would give 7 cm.
    assert ground[:, 2].std() < 0.02
    assert ground[:, 2].mean() == pytest.approx(-1.5, abs=0.02)
    # Forward stays forward: the short way turns nothing about z.
    assert abs(T[1, 2]) < 0.02
