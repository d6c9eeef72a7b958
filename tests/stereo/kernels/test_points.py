"""The compiled back-projection equals its reference."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.stereo.kernels.points import Maps, PointRules, make_points
from tests.stereo.kernels.points_reference import make_points_reference

RULES = PointRules(
    focal=100.0,
    cx=12.3,
    cy=7.7,
    fb=20.0,
    doffs=2.0,
    nearest=0.1,
    farthest=8.0,
    relative_sigma=0.2,
    confidence=0.2,
    stride=1,
    radius=3,
)


def make_maps(seed: int, height: int, width: int, *, known: float, channels: int) -> Maps:
    """A slanted surface with noise, steps, holes, negative values."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    values = 6 + 0.3 * u - 0.2 * v + np.where(u > width // 2, 9.0, 0.0)
    values += rng.normal(0, 0.3, values.shape)
    values[rng.random(values.shape) < 0.05] = -3.0
    values[rng.random(values.shape) > known] = np.nan
    made = Maps(
        values.astype(np.float32),
        rng.random(values.shape).astype(np.float32),
        rng.uniform(0.05, 0.6, values.shape).astype(np.float32),
        rng.integers(0, 256, (height, width, channels), dtype=np.uint8),
        rng.random(values.shape) < 0.9 if channels == 3 else np.zeros((0, 0), np.bool_),
    )
    for image in made[:-1]:
        image.flags.writeable = False  # as those of a disparity: kernels are compiled for them
    return made


maps = st.builds(
    make_maps,
    seed=st.integers(0, 2**20),
    height=st.integers(1, 20),
    width=st.integers(1, 30),
    known=st.sampled_from([0.0, 0.1, 0.6, 1.0]),
    channels=st.sampled_from([1, 3]),
)


@given(maps, st.integers(0, 4), st.integers(1, 3))
@settings(max_examples=150)
def test_points_equal_their_reference(given_maps: Maps, radius: int, stride: int) -> None:
    rules = RULES._replace(radius=radius, stride=stride)
    ours = make_points(given_maps, rules)
    reference = make_points_reference(given_maps, rules)
    # Both compute in float64 and round to float32 at the end: to its next value at most.
    rtol, atol = 2.0**-23, 0.0
    if numba.config.DISABLE_JIT:
        # numpy then does each of three operations in float32, and first rounds the principal point
        # (below 32 px) to it; that is multiplied by depth (below 10 m) over focal length (100 px).
        rtol, atol = 4 * 2.0**-23, 32 * 2.0**-24 * 10 / 100
    np.testing.assert_allclose(ours.xyz, reference.xyz, rtol=rtol, atol=atol)
    np.testing.assert_allclose(ours.sigma, reference.sigma, rtol=2.0**-23)
    np.testing.assert_array_equal(ours.confidence, reference.confidence)
    np.testing.assert_array_equal(ours.colours, reference.colours)
    # The kernel adds up to 81 disparities below 26 px in float32, each within 4 px of the centre,
    # in 18 steps: a covariance is off by 38 · 2^-24 · 4 · 26 = 2.4e-4 at most, a slope by that over
    # the window's variance across its narrow side (0.2 where few pixels are known: 1.2e-3), and the
    # direction by 100 (the focal length) times that over the normal's length (60 on this slope).
    np.testing.assert_allclose(ours.normals, reference.normals, atol=2e-3)


def test_without_a_radius_there_are_no_normals() -> None:
    given_maps = make_maps(1, 12, 20, known=1.0, channels=1)
    assert make_points(given_maps, RULES._replace(radius=0)).normals.shape == (0, 3)


@pytest.mark.parametrize("limit", ["nearest", "farthest", "relative_sigma", "confidence"])
def test_each_limit_drops_points(limit: str) -> None:
    given_maps = make_maps(2, 20, 30, known=1.0, channels=1)
    free = RULES._replace(nearest=0.0, farthest=1e9, relative_sigma=1e9, confidence=0.0)
    strict = {"nearest": 1.0, "farthest": 1.0, "relative_sigma": 0.02, "confidence": 0.5}
    fewer = make_points(given_maps, free._replace(**{limit: strict[limit]}))
    assert 0 < len(fewer.xyz) < len(make_points(given_maps, free).xyz)
