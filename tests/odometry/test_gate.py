from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.odometry.covariance import step_covariance
from recon.odometry.gate import Correction, icp_covariance, judge
from recon.odometry.surfaces import Fit, describe_surfaces, fit_surfaces

UNSURE = step_covariance(0.3, 1.0)
SURE = step_covariance(0.002, 0.005)
NOTHING = np.zeros(6)


def corridor(ends: bool) -> np.ndarray:
    """Points (N, 3) on ground, ceiling and walls along z, with or without walls across it."""
    rng = np.random.default_rng(5)
    n = 4000
    x, y, z = rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(-12, 12, n)
    planes = [np.c_[x, np.full(n, s * 2.05), z] for s in (-1, 1)]
    planes += [np.c_[np.full(n, s * 3.05), y, z] for s in (-1, 1)]
    planes += [np.c_[x, y, np.full(n, s * 12.05)] for s in (-1, 1) if ends]
    return np.concatenate(planes)


def corrected(xyz: np.ndarray, step: np.ndarray) -> Correction:
    """ICP would move a frame by ``step``, and would fit the map better there."""
    surfaces = describe_surfaces(xyz, 1.0)
    fit = fit_surfaces(xyz[::7], surfaces)
    before = Fit(fit.overlap, 0.2, fit.information)
    return Correction(step, before, Fit(fit.overlap, 0.1, fit.information))


def test_a_corridor_takes_nothing_along_itself_and_all_across() -> None:
    step = np.array([0.1, 0.05, 0.4, 0.0, 0.0, 0.0])
    verdict = judge(corrected(corridor(ends=False), step), NOTHING, UNSURE)
    assert verdict.accepted
    # 2 % remain to the prior across; along, nothing fixes the camera.
    np.testing.assert_allclose(verdict.step[:2], step[:2], rtol=0.02)
    assert abs(verdict.step[2]) < 0.01 * step[2]


def test_walls_across_the_corridor_fix_the_way_along_it() -> None:
    step = np.array([0.1, 0.05, 0.4, 0.0, 0.0, 0.0])
    verdict = judge(corrected(corridor(ends=True), step), NOTHING, UNSURE)
    np.testing.assert_allclose(verdict.step[:3], step[:3], rtol=0.02)


def test_a_sure_prior_stays() -> None:
    step = np.array([0.01, 0.0, 0.01, 0.0, 0.0, 0.0])
    verdict = judge(corrected(corridor(ends=True), step), NOTHING, SURE)
    assert not verdict.accepted
    assert "no better" in verdict.note
    np.testing.assert_array_equal(verdict.step, 0.0)


def test_a_correction_far_outside_both_uncertainties_is_refused() -> None:
    step = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    verdict = judge(corrected(corridor(ends=True), step), NOTHING, SURE)
    assert not verdict.accepted
    assert "sigma" in verdict.note


def test_the_standing_offset_is_no_news() -> None:
    step = np.array([0.1, 0.05, 0.4, 0.0, 0.01, 0.0])
    verdict = judge(corrected(corridor(ends=True), step), step, UNSURE)
    np.testing.assert_allclose(verdict.step, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("before", "after", "overlap", "told"),
    [
        (0.10, 0.05, 0.3, "overlap"),
        (0.10, 0.10, 0.9, "residual"),
        (0.10, 0.20, 0.9, "residual"),
        (np.nan, np.nan, 0.9, "residual"),
    ],
)
def test_a_correction_that_does_not_fit_better_is_refused(
    before: float, after: float, overlap: float, told: str
) -> None:
    information = np.eye(6) * 1e5
    correction = Correction(
        np.full(6, 0.01), Fit(overlap, before, information), Fit(overlap, after, information)
    )
    verdict = judge(correction, NOTHING, UNSURE)
    assert not verdict.accepted
    assert told in verdict.note


@given(seed=st.integers(0, 10_000), scale=st.floats(1e-4, 0.3))
def test_no_more_is_taken_than_is_offered(seed: int, scale: float) -> None:
    """In the metric of both uncertainties the step taken is shorter than the one offered."""
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(2, 6, 6))
    prior = scale**2 * (A @ A.T + 0.1 * np.eye(6))
    fit = Fit(0.9, 0.1, 1e3 * B @ B.T)
    step = scale * rng.normal(size=6)
    verdict = judge(Correction(step, Fit(0.9, 0.2, fit.information), fit), NOTHING, prior)
    both = prior + icp_covariance(fit)
    assert verdict.step @ np.linalg.solve(both, verdict.step) <= step @ np.linalg.solve(both, step)
