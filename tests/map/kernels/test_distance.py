"""The surface through points: that of the reference, on the true one, whole and manifold."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from recon.map.kernels.distance import _manifold, _triangles, surface_of
from tests.map.kernels import reference


def scattered(seed: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of no surface: sheets meet in cells in every possible way."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(number, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return rng.uniform(-3, 3, (number, 3)), normals.astype(np.float32)


def sphere(radius: float, number: int) -> tuple[np.ndarray, np.ndarray]:
    normals = np.random.default_rng(0).normal(size=(number, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals + [0.3, 0.1, 0.2], normals.astype(np.float32)


def sheet(width: float, hole: float = 0.0, step: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """A level square around the origin, facing up, with a square hole."""
    x, y = (
        axis.ravel()
        for axis in np.mgrid[-width / 2 : width / 2 : step, -width / 2 : width / 2 : step]
    )
    kept = np.maximum(abs(x), abs(y)) >= hole / 2
    xyz = np.stack([x, y, np.full_like(x, 0.37)], axis=1)[kept]
    return xyz, np.tile(np.float32([0, 0, 1]), (len(xyz), 1))


def directed(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def border(faces: np.ndarray) -> np.ndarray:
    """The edges (E, 2) of one face only."""
    edges, count = np.unique(np.sort(directed(faces), axis=1), axis=0, return_counts=True)
    return edges[count == 1]


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.sampled_from([1.0, 2.0, math.inf]))
def test_surfaces_equal_those_of_the_reference(seed, number, farthest):
    xyz, normals = scattered(seed, number)
    distance = reference.distance_reference(xyz, normals, farthest)
    # The kernel sums in float32, by which the sign of the smallest may be another.
    assume(min(map(abs, distance.values()), default=1.0) > 1e-5)
    quads = np.array(reference.surface_reference(distance)).reshape(-1, 4, 3)
    corners, rows = np.unique(quads.reshape(-1, 3).round(4), axis=0, return_inverse=True)
    expected = _manifold(_triangles(corners, rows.reshape(-1, 4).astype(np.int32)))
    vertices, faces = surface_of(xyz, normals, farthest)
    assert len(faces) == len(expected)
    for one, other in ((vertices[faces], corners[expected]), (corners[expected], vertices[faces])):
        if len(one):
            away = np.abs(one[:, None].mean(axis=2) - other[None].mean(axis=2)).max(axis=2)
            assert away.min(axis=1).max() < 1e-3


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_no_edge_has_more_than_two_triangles_and_these_are_oriented_alike(seed, number):
    _, faces = surface_of(*scattered(seed, number), math.inf)
    edges = directed(faces)
    assert len(np.unique(edges, axis=0)) == len(edges)


def test_a_sphere_is_closed_and_where_it_is():
    xyz, normals = sphere(8.0, 4000)
    vertices, faces = surface_of(xyz, normals, 2.0)
    used = np.unique(faces)
    assert len(border(faces)) == 0
    assert len(used) - 3 * len(faces) // 2 + len(faces) == 2  # Euler
    radius = np.linalg.norm(vertices[used] - [0.3, 0.1, 0.2], axis=1)
    # The mean of planes over a standard deviation of a cell is off by its curvature.
    assert np.abs(radius - 8.0).max() < 2 * 1.0 / 8.0
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a - [0.3, 0.1, 0.2]) > 0).all()


def test_a_sheet_ends_where_its_points_do():
    ends = []
    for farthest in (0.8, 2.0):
        vertices, faces = surface_of(*sheet(20.0), farthest)
        x, y, z = vertices[np.unique(faces)].T
        np.testing.assert_allclose(z, 0.37, atol=1e-5)
        ends.append(max(x.max(), y.max()))
        # The last points are at 9.2; a vertex is in the middle of a cell whose corners are known.
        assert 9.2 - 1.0 < ends[-1] < 9.2 + farthest
    assert ends[0] < ends[1]


@pytest.mark.parametrize(("hole", "closed"), [(3.2, True), (8.0, False)])
def test_a_narrow_hole_is_closed_and_a_wide_one_stays(hole, closed):
    vertices, faces = surface_of(*sheet(24.0, hole), 2.0)
    inner = np.abs(vertices[border(faces)]).max(axis=(1, 2)) < 8
    assert inner.any() != closed


@pytest.mark.parametrize("thickness", [0.5, 1.0, 2.0])
def test_the_sides_of_a_thin_wall_stay_apart(thickness):
    xyz, normals = sheet(16.0)
    both = np.concatenate([xyz, xyz + np.array([0, 0, thickness])])
    vertices, faces = surface_of(both, np.concatenate([-normals, normals]), 2.0)
    z = vertices[np.unique(faces)][:, 2] - 0.37
    upper = z > thickness / 2
    assert np.abs(z - np.where(upper, thickness, 0)).max() < 0.3
    assert 0.4 < upper.mean() < 0.6


def test_no_point_gives_no_surface():
    vertices, faces = surface_of(np.zeros((0, 3)), np.zeros((0, 3), np.float32), 2.0)
    assert (vertices.shape, faces.shape) == ((0, 3), (0, 3))
