"""Cutting a mesh keeps the right faces and renumbers its vertices."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import MeshingError
from recon.export.mesh.surgery import drop_small_components, keep_vertices, vertex_normals

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def test_a_face_stays_only_with_all_three_vertices() -> None:
    vertices, faces = keep_vertices(SQUARE, HALVES, np.array([True, False, True, True]))
    np.testing.assert_array_equal(vertices, SQUARE[[0, 2, 3]])
    np.testing.assert_array_equal(faces, [[0, 1, 2]])


def test_components_below_the_size_go() -> None:
    vertices = np.concatenate([SQUARE, SQUARE[:3] + 10])
    faces = np.concatenate([HALVES, [[4, 5, 6]]]).astype(np.int32)
    kept, left = drop_small_components(vertices, faces, 2)
    np.testing.assert_array_equal(kept, SQUARE)
    np.testing.assert_array_equal(left, HALVES)


def test_nothing_left_is_an_error() -> None:
    with pytest.raises(MeshingError, match="trimming left no face"):
        drop_small_components(SQUARE, HALVES, 3)


def test_normals_of_a_flat_square_are_its_normal() -> None:
    np.testing.assert_allclose(vertex_normals(SQUARE, HALVES), [[0, 0, 1]] * 4)
    np.testing.assert_allclose(vertex_normals(SQUARE, HALVES[:, ::-1]), [[0, 0, -1]] * 4)


def test_large_faces_weigh_more() -> None:
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, -1]], dtype=np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    # Areas 4.5 (normal z) and 1.5 (normal -x) at the shared vertices.
    expected = np.array([-1.5, 0, 4.5]) / np.hypot(1.5, 4.5)
    np.testing.assert_allclose(vertex_normals(vertices, faces)[0], expected, atol=1e-6)
