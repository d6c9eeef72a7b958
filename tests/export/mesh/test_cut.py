"""Cut meshes keep their surface, end in the plane, and meet the other half without a gap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import MeshingError
from recon.core.values import TriangleMesh
from recon.export.mesh.cut import (
    Plane,
    close_seam,
    cut_mesh,
    drop_small_components,
    keep_vertices,
    nearest_on_edges,
    open_edges,
    vertex_normals,
)


def sheet(seed: int, n: int = 24, shift_m: float = 0.0, noise_m: float = 0.0) -> TriangleMesh:
    """A wavy sheet over [-1, 1]², triangles as its vertices were jittered; it faces up."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    x, y = (v + rng.uniform(-0.4 / n, 0.4 / n, v.shape) for v in (x, y))
    z = 0.1 * np.sin(3 * x) * np.cos(4 * y) + shift_m + rng.normal(0, noise_m, x.shape)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + n, corner + n + 1], axis=1),
            np.stack([corner, corner + n + 1, corner + 1], axis=1),
        ]
    )
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    rgb = np.repeat(np.uint8(127 + 120 * x.ravel()[:, None].clip(-1, 1)), 3, axis=1)
    normals = np.tile(np.float32([0, 0, 1]), (n * n, 1))
    return TriangleMesh(vertices, faces.astype(np.int32), normals, rgb)


def area_m2(mesh: TriangleMesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def ups(mesh: TriangleMesh) -> np.ndarray:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    return np.cross(b - a, c - a)[:, 2]


@given(axis=st.integers(0, 1), at=st.floats(-0.9, 0.9), seed=st.integers(0, 5))
def test_the_halves_are_the_whole(axis: int, at: float, seed: int) -> None:
    mesh, plane = sheet(seed), Plane(axis, at)
    halves = [cut_mesh(mesh, plane, keep_above=above) for above in (False, True)]
    # float32 places new vertices to 1e-7 m.
    assert sum(map(area_m2, halves)) == pytest.approx(area_m2(mesh), rel=1e-5)
    assert halves[0].vertices[:, axis].max() == np.float32(at)
    assert halves[1].vertices[:, axis].min() == np.float32(at)
    for half in halves:
        assert (ups(half) > -1e-9).all()
        assert set(np.unique(half.faces)) == set(range(len(half.vertices)))
    borders = [np.unique(open_edges(half, plane).reshape(-1, 3), axis=0) for half in halves]
    np.testing.assert_array_equal(borders[0], borders[1])


def test_new_vertices_have_normals_and_colours_between() -> None:
    half = cut_mesh(sheet(0), Plane(0, 0.0), keep_above=True)
    on_plane = half.vertices[:, 0] == 0
    assert half.rgb is not None
    assert half.normals is not None
    assert np.abs(half.rgb[on_plane].astype(int) - 127).max() <= 12
    np.testing.assert_allclose(np.linalg.norm(half.normals, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("above", [True, False])
def test_a_mesh_on_one_side_is_kept_or_dropped_whole(above: bool) -> None:
    mesh = sheet(1)
    kept = cut_mesh(mesh, Plane(0, -5.0 if above else 5.0), keep_above=above)
    assert len(kept.faces) == len(mesh.faces)
    assert len(cut_mesh(mesh, Plane(0, 5.0 if above else -5.0), keep_above=above).faces) == 0


def gap_m(one: TriangleMesh, other: TriangleMesh, plane: Plane) -> float:
    """Farthest that a point of one border is from the other border, sampled along the edges."""
    worst = 0.0
    for first, second in ((one, other), (other, one)):
        edges = open_edges(first, plane)
        along = np.linspace(0, 1, 7, dtype=np.float32)[None, :, None]
        points = edges[:, :1] * (1 - along) + edges[:, 1:] * along
        found = nearest_on_edges(points.reshape(-1, 3), open_edges(second, plane))
        worst = max(worst, float(found.distance_m.max()))
    return worst


@pytest.mark.parametrize("n", [12, 24, 57])
def test_a_seam_between_two_versions_of_a_surface_is_closed(n: int) -> None:
    plane = Plane(0, 0.1)
    left = cut_mesh(sheet(2), plane, keep_above=False)
    right = cut_mesh(sheet(3, n, shift_m=0.02, noise_m=0.005), plane, keep_above=True)
    assert gap_m(left, right, plane) > 0.01
    closed = close_seam(right, plane, open_edges(left, plane), 0.2)
    # Both ends of the seam lie where the sheets end, up to 0.02 m apart.
    middle = Plane(0, 0.1)
    assert gap_m(_within(left, 0.9), _within(closed, 0.9), middle) < 1e-5
    assert area_m2(closed) == pytest.approx(area_m2(right), rel=0.02)
    assert (ups(closed) > -1e-9).all()


def _within(mesh: TriangleMesh, y_m: float) -> TriangleMesh:
    """The mesh between two planes across y."""
    below = cut_mesh(mesh, Plane(1, y_m), keep_above=False)
    return cut_mesh(below, Plane(1, -y_m), keep_above=True)


def test_a_seam_whose_neighbour_is_far_stays_as_it_is() -> None:
    plane = Plane(0, 0.0)
    left = cut_mesh(sheet(2), plane, keep_above=False)
    right = cut_mesh(sheet(3, shift_m=1.0), plane, keep_above=True)
    closed = close_seam(right, plane, open_edges(left, plane), 0.2)
    np.testing.assert_array_equal(closed.vertices, right.vertices)
    np.testing.assert_array_equal(closed.faces, right.faces)


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def test_a_face_stays_only_with_all_its_vertices_and_in_a_large_component() -> None:
    vertices, faces = keep_vertices(SQUARE, HALVES, np.array([True, False, True, True]))
    np.testing.assert_array_equal(vertices, SQUARE[[0, 2, 3]])
    np.testing.assert_array_equal(faces, [[0, 1, 2]])
    both = np.concatenate([HALVES, [[4, 5, 6]]]).astype(np.int32)
    kept, left = drop_small_components(np.concatenate([SQUARE, SQUARE[:3] + 10]), both, 2)
    np.testing.assert_array_equal(kept, SQUARE)
    np.testing.assert_array_equal(left, HALVES)
    with pytest.raises(MeshingError, match="trimming left no face"):
        drop_small_components(SQUARE, HALVES, 3)


def test_normals_of_a_flat_square_are_its_normal_and_large_faces_weigh_more() -> None:
    np.testing.assert_allclose(vertex_normals(SQUARE, HALVES), [[0, 0, 1]] * 4)
    np.testing.assert_allclose(vertex_normals(SQUARE, HALVES[:, ::-1]), [[0, 0, -1]] * 4)
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, -1]], dtype=np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    # Areas 4.5 (normal z) and 1.5 (normal -x) at the shared vertices.
    expected = np.array([-1.5, 0, 4.5]) / np.hypot(1.5, 4.5)
    np.testing.assert_allclose(vertex_normals(vertices, faces)[0], expected, atol=1e-6)
