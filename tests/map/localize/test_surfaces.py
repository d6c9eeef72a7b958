"""Surfaces of a map fix a pose where they can, and correct it where that is worth it."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.se3 import apply, as_transform
from recon.map.localize.surfaces import NOISE_M, Fit, describe_surfaces, fit_surfaces
from recon.map.localize.surroundings import Correction, contrast, is_worthwhile
from recon.odometry.window import step_covariance


def wall(points: int = 3000, noise_m: float = 0.0) -> np.ndarray:
    """Points on the plane z = 5.5."""
    rng = np.random.default_rng(2)
    xy = rng.uniform(-4, 4, (points, 2))
    return np.c_[xy, 5.5 + noise_m * rng.normal(size=points)]


@pytest.mark.parametrize("shift_m", [0.0, 0.05, 0.2, -0.3])
def test_the_residual_is_the_distance_to_the_wall(shift_m: float) -> None:
    moved = wall() + np.array([0.0, 0.0, shift_m])
    fit = fit_surfaces(moved, describe_surfaces(wall(), 1.0))
    assert fit.residual_m == pytest.approx(abs(shift_m), rel=1e-6, abs=1e-9)
    assert (fit.overlap == 1.0) or shift_m
    assert fit_surfaces(moved, describe_surfaces(moved[:0], 1.0)).overlap == 0.0


def test_a_wall_fixes_one_translation_and_two_rotations() -> None:
    information = fit_surfaces(wall(), describe_surfaces(wall(), 1.0)).information
    values = np.linalg.eigvalsh(information)
    # Three directions are free (slide twice, spin), three are not.
    assert values[2] < 1e-6 * values[-1]
    assert values[3] > 1e-3 * values[-1]


def test_a_bush_fixes_nothing() -> None:
    bush = np.random.default_rng(4).uniform(-4, 4, (20_000, 3))
    fit = fit_surfaces(bush, describe_surfaces(bush, 1.0))
    assert fit.overlap == 1.0
    assert np.isnan(fit.residual_m)
    np.testing.assert_array_equal(fit.information, 0.0)
    np.testing.assert_array_equal(describe_surfaces(wall(5), 100.0).information, 0.0)


def test_information_is_the_curvature_of_the_squared_distance() -> None:
    """Second difference of the cost along each step against the diagonal."""
    xyz = wall(noise_m=0.03)
    surfaces = describe_surfaces(xyz, 1.0)
    fit = fit_surfaces(xyz, surfaces)
    h = 1e-4

    def cost(step: np.ndarray) -> float:
        moved = apply(as_transform(step), xyz)
        # Cells stay as they are for so small a step but for points on their rims.
        return sum(
            float((p - m) @ W @ (p - m)) for p, m, W in zip(moved, means, information, strict=True)
        )

    cell = np.searchsorted(surfaces.keys, _keys_of(xyz))
    means, information = surfaces.means[cell], surfaces.information[cell]
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = h
        curvature = (cost(step) - 2 * cost(np.zeros(6)) + cost(-step)) / (2 * h * h)
        # The rest of the curvature is the residuals' own, some 1/1000 here.
        assert curvature == pytest.approx(fit.information[axis, axis], rel=0.02, abs=1 / NOISE_M**2)


def _keys_of(xyz: np.ndarray) -> np.ndarray:
    index = np.floor(xyz).astype(np.int64) + (1 << 20)
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]


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


@pytest.mark.parametrize(
    ("step_m", "ends", "prior", "worth"),
    [
        ((0.1, 0.05, 0.4), True, UNSURE, True),
        ((0.0, 0.0, 0.0), True, UNSURE, True),
        ((2.0, 0.0, 0.0), True, UNSURE, False),  # far outside both uncertainties
        ((0.01, 0.0, 0.01), True, SURE, False),
        ((0.1, 0.05, 0.0), True, UNSURE, True),
        # A corridor that goes on fits as well half a metre on, whatever it says of the sides.
        ((0.1, 0.05, 0.0), False, UNSURE, False),
    ],
)
def test_surfaces_correct_a_pose_that_they_know_better(
    step_m: tuple[float, ...], ends: bool, prior: np.ndarray, worth: bool
) -> None:
    step = np.array([*step_m, 0.0, 0.0, 0.0])
    assert is_worthwhile(corrected(corridor(ends), step), prior) is worth


def test_a_corridor_tells_nothing_along_itself() -> None:
    """A prior that is sure of all but the way along it stays."""
    along = SURE + np.diag([0.0, 0.0, 0.3**2, 0.0, 0.0, 0.0])
    step = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    assert not is_worthwhile(corrected(corridor(ends=False), step), along)
    assert is_worthwhile(corrected(corridor(ends=True), step), along)


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
