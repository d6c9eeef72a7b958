"""Slopes of surfaces around features equal those of plain numpy, and of a plane its own."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.odometry.kernels.patches import Surface, fit_slopes

SURFACE = Surface(radius=4, step=2, near=1.0, least=6, rounds=3)


def slopes_reference(values, uv, surface):
    offset = np.arange(-surface.radius, surface.radius + 1, surface.step)
    right, down = (x.ravel() for x in np.meshgrid(offset, offset))
    column, row = np.rint(uv).astype(int).T
    height, width = values.shape
    rows, columns = row[:, None] + down, column[:, None] + right
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    around = values[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(float)
    around = np.where(inside, around, np.nan)
    A = np.stack([np.ones(len(right)), right, down], axis=1)
    found = np.zeros((len(uv), 2))
    for n, seen in enumerate(around):
        plane = np.array([values[row[n].clip(0, height - 1), column[n].clip(0, width - 1)], 0, 0])
        for _ in range(surface.rounds):
            on = np.abs(seen - A @ plane) <= surface.near
            if on.sum() < surface.least:
                plane = plane * [1, 0, 0]
                continue
            H = A[on].T @ A[on] + np.diag([0, 1, 1])
            plane = np.linalg.solve(H, A[on].T @ seen[on])
        found[n] = plane[1:]
    return found


@given(seed=st.integers(0, 2**32 - 1), known=st.sampled_from([0.2, 0.7, 1.0]))
def test_slopes_equal_those_of_the_reference(seed, known):
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:12, :17]
    across, down = rng.uniform(-0.3, 0.3, 2)
    # Multiples of an eighth, and limits between them: rounding moves none across a limit.
    values = np.round(8 * (40 + across * u + down * v + np.where(u > 9, 6, 0))) / 8
    values[rng.random(values.shape) > known] = np.nan
    uv = rng.uniform([-2, -2], [19, 14], (5, 2))
    surface = SURFACE._replace(near=1.0 + 1 / 16, rounds=1)
    found = fit_slopes(values.astype(np.float32), uv, surface)
    # 25 values of 50 px, summed and divided in float64.
    np.testing.assert_allclose(found, slopes_reference(values, uv, surface), rtol=0, atol=1e-10)


def test_a_plane_has_its_slope_and_what_is_not_on_it_does_not_count():
    v, u = np.mgrid[:20, :30]
    values = (30 + 0.1 * u - 0.2 * v).astype(np.float32)
    values[:, 20:] += 10
    values[3, 5] = np.nan
    found = fit_slopes(values, np.array([[6.0, 8.0], [17.4, 9.0]]), SURFACE)
    # The ridge of a squared pixel against 200 of them.
    assert found == pytest.approx(np.tile([0.1, -0.2], (2, 1)), rel=0.02)
    assert found == pytest.approx(slopes_reference(values, np.array([[6, 8], [17.4, 9]]), SURFACE))


def test_where_nothing_is_known_a_surface_is_upright():
    values = np.full((9, 9), np.nan, np.float32)
    assert not fit_slopes(values, np.array([[4.0, 4.0], [-3.0, 20.0]]), SURFACE).any()
    values[4, 2:7] = 5.0  # fewer than needed
    assert not fit_slopes(values, np.array([[4.0, 4.0]]), SURFACE).any()
    assert fit_slopes(values, np.zeros((0, 2)), SURFACE).shape == (0, 2)
