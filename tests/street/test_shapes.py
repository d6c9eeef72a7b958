"""Shapes are closed, of the right size, and textured in metres."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.geometry import se3
from recon.street.materials import both, stripe, stripes, tile_joints, tile_tone
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


@pytest.mark.parametrize(
    ("soup", "area", "closed"),
    [
        (boxes([0, 0, 0], [1, 2, 3], PAINT), 22.0, True),
        (cylinder((0.5, 0.5), 2.0, PAINT, 64), 2.0 * np.pi, False),
        (disc(2.0, PAINT, 100), 4.0 * np.pi, False),
        (extrusion([(0, 0), (2, 0), (2, 1), (0, 1)], 1.5, PAINT), 13.0, True),
        (frustum([0, 0, 0], [1, 2, 3], (0, 0, 0), PAINT), 18.0, False),
    ],
    ids=["box", "cylinder", "disc", "extrusion", "frustum"],
)
def test_shapes_have_their_area_and_are_closed(soup, area: float, closed: bool):
    assert _area(soup) == pytest.approx(area, rel=2e-3)
    assert (_open_edges(soup.vertices) == 0) == closed
    assert np.allclose(np.linalg.norm(soup.normals, axis=2), 1.0)


@pytest.mark.parametrize("splits", [0, 1, 3])
def test_an_icosphere_is_closed_and_round(splits):
    triangles = icosphere(splits)
    assert len(triangles) == 20 * 4**splits
    assert np.allclose(np.linalg.norm(triangles, axis=2), 1.0)
    assert _open_edges(triangles) == 0


def test_a_bumpy_ball_is_closed_and_near_its_radius():
    ball = bumpy_ball([2.0, 2.0, 2.0], PAINT, bump=0.2, wavelength=0.4)
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


@given(
    x=st.floats(-20, 20),
    period=st.floats(0.2, 5),
    share=st.floats(0.05, 0.95),
    w=st.floats(0.01, 9),
)
def test_stripes_are_the_mean_over_the_footprint(x, period, share, w):
    fine = x + w * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    expected = ((fine % period) < share * period).mean()
    got = stripes(np.array([x]), period, share * period, np.array([w]))[0]
    # 4000 samples place each stripe's edge to w/4000; there are at most 2·(9 / 0.2 + 1) edges.
    assert got == pytest.approx(expected, abs=0.03)


def test_a_stripe_covers_its_share_of_a_footprint():
    x = np.array([-0.1, 0.1, 0.4, 0.6])
    assert np.allclose(stripe(x, 0.0, 0.5, np.zeros(4)), [0, 1, 1, 0])
    assert stripe(np.array([0.5]), 0.0, 0.5, np.array([0.2]))[0] == pytest.approx(0.5)


def test_a_tile_has_one_tone_and_its_neighbour_another():
    uv = np.array([[0.1, 0.1], [0.4, 0.3], [0.6, 0.1]])
    tone = tile_tone(uv, (0.5, 0.5), np.zeros((3, 2)), np.zeros(3, int))
    assert tone[0] == tone[1] != tone[2]


def test_tones_fade_where_a_pixel_covers_many_tiles():
    uv = np.random.default_rng(0).uniform(0, 100, (500, 2))
    tone = tile_tone(uv, (0.1, 0.1), np.full((500, 2), 2.0), np.zeros(500, int))
    assert np.abs(tone).max() < 0.01


def test_joints_cover_their_share_of_an_area():
    uv = np.random.default_rng(0).uniform(0, 100, (50, 2))
    got = tile_joints(uv, (0.5, 0.25), 0.05, np.full((50, 2), 40.0))
    # 10 % of the columns, 20 % of the rows, the crossings once.
    assert np.allclose(got, both(np.array(0.1), np.array(0.2)), atol=0.01)
