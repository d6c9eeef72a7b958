"""Patterns are averaged exactly over the footprint of a pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.street.materials import both, stripe, stripes, tile_joints, tile_tone


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


def test_a_wide_footprint_sees_the_share_of_the_stripes():
    got = stripes(np.linspace(0, 1, 7), 0.01, 0.003, np.full(7, 1.0))
    assert np.allclose(got, 0.3)


def test_a_point_sees_a_stripe_or_not():
    x = np.array([-0.1, 0.1, 0.4, 0.6])
    assert np.allclose(stripe(x, 0.0, 0.5, np.zeros(4)), [0, 1, 1, 0])


def test_half_a_footprint_on_a_stripe_is_half():
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
