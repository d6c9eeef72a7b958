"""Rays hit the nearest triangle; segments report occlusions."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import ShapeError
from recon.core.open3d_raycasting import RayScene


def _square(z: float, half: float = 1.0) -> np.ndarray:
    a, b, c, d = ([-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z])
    return np.array([[a, b, c], [a, c, d]])


@pytest.fixture(scope="module")
def scene() -> RayScene:
    return RayScene(np.concatenate([_square(2.0), _square(5.0, 3.0)]))


def test_the_nearest_triangle_is_hit(scene):
    rays = np.array([[0.3, 0.1, 1.0], [-0.1, 0.3, 1.0], [0.55, 0.1, 1.0]])
    hits = scene.first_hit(np.zeros(3), rays)
    assert hits.dtype == np.int32
    assert hits.tolist() == [0, 1, 2]


def test_a_ray_that_misses_gives_minus_one(scene):
    rays = np.array([[0.0, 0.0, -1.0], [5.0, 0.0, 1.0]])
    assert scene.first_hit(np.zeros(3), rays).tolist() == [-1, -1]


def test_triangles_are_hit_from_behind(scene):
    assert scene.first_hit(np.array([0.0, 0.0, 9.0]), np.array([[0.2, 0.1, -4.0]]))[0] in (2, 3)


def test_a_segment_is_blocked_only_between_its_ends(scene):
    reach = np.array([[0.0, 0.1, 1.9], [0.0, 0.1, 2.1], [0.0, 0.1, 4.0]])
    assert scene.blocked(np.zeros(3), reach).tolist() == [False, True, True]
    assert scene.blocked(np.zeros(3), reach, far=0.45).tolist() == [False, False, False]


def test_each_segment_may_have_its_own_start(scene):
    starts = np.array([[0.0, 0.1, 0.0], [0.0, 0.1, 3.0]])
    assert scene.blocked(starts, np.array([[0, 0, 2.5], [0, 0, 1.5]])).tolist() == [True, False]


def test_read_only_and_single_precision_arrays_are_taken():
    triangles = _square(1.0).astype(np.float32)
    rays = np.array([[0.1, 0.0, 1.0]], dtype=np.float32)
    for array in (triangles, rays):
        array.flags.writeable = False
    assert RayScene(triangles).first_hit(np.zeros(3), rays)[0] >= 0


def test_the_number_of_threads_changes_no_answer(scene):
    rng = np.random.default_rng(0)
    triangles = rng.uniform(-5, 5, (400, 1, 3)) + rng.normal(0, 0.4, (400, 3, 3))
    rays = rng.normal(size=(3000, 3))
    one, many = (RayScene(triangles, n).first_hit(np.zeros(3), rays) for n in (1, 0))
    assert (one >= 0).any()
    assert np.array_equal(one, many)


def test_no_rays_give_no_answers(scene):
    assert scene.first_hit(np.zeros(3), np.empty((0, 3))).shape == (0,)
    assert scene.blocked(np.zeros(3), np.empty((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    "broken", [np.empty((0, 3, 3)), np.zeros((4, 3)), np.full((1, 3, 3), np.nan)]
)
def test_bad_triangles_are_refused(broken):
    with pytest.raises(ShapeError):
        RayScene(broken)
