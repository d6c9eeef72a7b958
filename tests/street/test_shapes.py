"""Shapes are closed, of the right size, and textured in metres."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.street.shapes import (
    Material,
    Paint,
    boxes,
    bumpy_ball,
    cylinder,
    disc,
    extrusion,
    frustum,
    icosphere,
    merge,
    move,
    quads,
)

PAINT = Paint(Material.BRICK, (0.2, 0.4, 0.6), 5)


def _area(soup) -> float:
    v = soup.vertices
    return 0.5 * np.linalg.norm(np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]), axis=1).sum()


def _open_edges(vertices: np.ndarray) -> int:
    """Edges that belong to an odd number of triangles."""
    keys = {}
    for triangle in np.round(vertices, 9):
        for k in range(3):
            edge = frozenset([tuple(triangle[k] + 0.0), tuple(triangle[(k + 1) % 3] + 0.0)])
            keys[edge] = keys.get(edge, 0) + 1
    return sum(count % 2 for count in keys.values())


def test_a_quad_has_its_area_and_metric_surface_coordinates():
    soup = quads([1, 2, 3], [2, 0, 0], [0, 0, 3], PAINT, (10.0, 20.0))
    assert _area(soup) == pytest.approx(6.0)
    assert soup.uv.reshape(-1, 2).min(axis=0).tolist() == [10.0, 20.0]
    assert soup.uv.reshape(-1, 2).max(axis=0).tolist() == [12.0, 23.0]


def test_a_box_is_closed_and_has_six_faces():
    soup = boxes([0, 0, 0], [1, 2, 3], PAINT)
    assert len(soup) == 12
    assert _area(soup) == pytest.approx(22.0)
    assert _open_edges(soup.vertices) == 0


def test_a_cylinder_mantle_tends_to_its_area():
    soup = cylinder((0.5, 0.5), 2.0, PAINT, 64)
    assert _area(soup) == pytest.approx(2.0 * np.pi, rel=1e-3)
    assert np.allclose(np.linalg.norm(soup.normals, axis=2), 1.0)


def test_a_disc_tends_to_its_area():
    assert _area(disc(2.0, PAINT, 100)) == pytest.approx(4.0 * np.pi, rel=2e-3)


def test_an_extrusion_is_closed():
    assert _open_edges(extrusion([(0, 0), (2, 0), (2, 1), (0, 1)], 1.5, PAINT).vertices) == 0


def test_a_frustum_without_inset_has_the_walls_of_a_box():
    assert _area(frustum([0, 0, 0], [1, 2, 3], (0, 0, 0), PAINT)) == pytest.approx(18.0)


@pytest.mark.parametrize("splits", [0, 1, 3])
def test_an_icosphere_is_closed_and_round(splits):
    triangles = icosphere(splits)
    assert len(triangles) == 20 * 4**splits
    assert np.allclose(np.linalg.norm(triangles, axis=2), 1.0)
    assert _open_edges(triangles) == 0


def test_a_bumpy_ball_is_closed_and_near_its_radius():
    ball = bumpy_ball([2.0, 2.0, 2.0], PAINT, bump=0.2, wavelength=0.4, seed=3)
    radius = np.linalg.norm(ball.vertices, axis=2)
    assert _open_edges(ball.vertices) == 0
    # Bumps reach 1.5 times the share that was asked for: one octave and half of another.
    assert 2.0 * (1 - 0.3) <= radius.min() < 2.0 < radius.max() <= 2.0 * (1 + 0.3)
    assert ((ball.normals * ball.vertices).sum(axis=2) > 0).all()


def test_moving_keeps_paint_and_turns_normals():
    T = se3.make_transform(se3.exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.array([5.0, 0, 0]))
    soup = merge([boxes([0, 0, 0], [1, 1, 1], PAINT), disc(1.0, PAINT)])
    moved = move(soup, T)
    assert np.array_equal(moved.uv, soup.uv)
    assert _area(moved) == pytest.approx(_area(soup))
    back = move(moved, se3.invert(T))
    assert np.allclose(back.vertices, soup.vertices)
    assert np.allclose(back.normals, soup.normals)
