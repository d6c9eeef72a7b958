from __future__ import annotations

import numpy as np
import pytest

from recon.map.localize.surfaces import Fit, describe_surfaces, fit_surfaces
from recon.map.localize.surroundings import Correction, contrast, is_worthwhile
from recon.odometry.window import step_covariance

UNSURE = step_covariance(0.3, 1.0)
SURE = step_covariance(0.002, 0.005)


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
    # Not to where an open corridor ends: there the map does.
    along_m = np.abs(xyz[:, 2])
    seen = xyz[(along_m < 11.0) | (along_m > 12.0)][::7]
    fit = fit_surfaces(seen, surfaces)
    before = Fit(fit.overlap, 0.2, fit.information)
    beside = contrast(seen, np.eye(4), surfaces)
    return Correction(step, before, Fit(fit.overlap, 0.1, fit.information), beside)


def test_walls_tell_where_a_camera_is_that_hardly_knows() -> None:
    step = np.array([0.1, 0.05, 0.4, 0.0, 0.0, 0.0])
    assert is_worthwhile(corrected(corridor(ends=True), step), UNSURE)


def test_a_corridor_tells_nothing_along_itself() -> None:
    """A prior that is sure of all but the way along it stays."""
    along = SURE + np.diag([0.0, 0.0, 0.3**2, 0.0, 0.0, 0.0])
    step = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    assert not is_worthwhile(corrected(corridor(ends=False), step), along)
    assert is_worthwhile(corrected(corridor(ends=True), step), along)


def test_surfaces_that_could_not_have_refused_a_pose_do_not_confirm_it() -> None:
    """A corridor that goes on fits as well half a metre on, whatever it says of the sides."""
    aside = np.array([0.1, 0.05, 0.0, 0.0, 0.0, 0.0])
    assert is_worthwhile(corrected(corridor(ends=True), aside), UNSURE)
    assert not is_worthwhile(corrected(corridor(ends=False), aside), UNSURE)


def test_a_sure_prior_stays() -> None:
    step = np.array([0.01, 0.0, 0.01, 0.0, 0.0, 0.0])
    assert not is_worthwhile(corrected(corridor(ends=True), step), SURE)


def test_a_correction_far_outside_both_uncertainties_is_refused() -> None:
    likely, far = np.zeros(6), np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert is_worthwhile(corrected(corridor(ends=True), likely), UNSURE)
    assert not is_worthwhile(corrected(corridor(ends=True), far), UNSURE)


@pytest.mark.parametrize(
    ("before", "after", "overlap", "worth"),
    [
        (0.10, 0.05, 0.9, True),
        (0.10, 0.05, 0.3, False),
        (0.10, 0.10, 0.9, False),
        (0.10, 0.20, 0.9, False),
        (np.nan, np.nan, 0.9, False),
    ],
)
def test_a_correction_must_fit_better(
    before: float, after: float, overlap: float, worth: bool
) -> None:
    information = np.eye(6) * 1e5
    correction = Correction(
        np.full(6, 0.01), Fit(overlap, before, information), Fit(overlap, after, information), 1e4
    )
    assert is_worthwhile(correction, UNSURE) is worth
