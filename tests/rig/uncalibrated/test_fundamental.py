from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.projection import map_pixels
from recon.core.geometry.se3 import exp_so3
from recon.rig.uncalibrated import (
    find_fundamental,
    fit_fundamental,
    line_distances,
    rectifying_homographies,
)
from recon.stereo.rectify.features import PairFeatures

SIZE = (640, 480)
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def true_matrix(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    x, y, z = shift
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = np.linalg.inv(K)
    return np.asarray(inverse.T @ cross @ exp_so3(np.array(turn)) @ inverse)


def matches(
    turn: tuple[float, float, float], shift: tuple[float, float, float], sigma_px: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    xyz = rng.uniform((-2, -1.5, 2), (2, 1.5, 8), (400, 3))
    both = [p @ K.T for p in (xyz, xyz @ exp_so3(np.array(turn)).T + shift)]
    left, right = (p[:, :2] / p[:, 2:] + rng.normal(0, sigma_px, (400, 2)) for p in both)
    return left, right


def seen(left: np.ndarray, right: np.ndarray) -> PairFeatures:
    return PairFeatures(left.astype(np.float32), right.astype(np.float32))


# The first three have their epipoles at infinity, or nearly: rows correspond as they are.
RIGS = [
    ((0.0, 0.0, 0.0), (-0.1, 0.0, 0.0)),
    ((1e-9, 0.0, 0.0), (-0.1, 1e-9, -1e-10)),
    ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0)),
    ((0.02, 0.0, 0.0), (-0.1, 0.0, 0.0)),
    ((0.03, -0.05, 0.04), (-0.15, 0.01, 0.02)),
    ((-0.05, 0.1, -0.1), (-0.15, -0.03, -0.04)),
]


@pytest.mark.parametrize(("turn", "shift"), RIGS)
def test_homographies_of_the_true_matrix_bring_partners_onto_one_row(turn, shift) -> None:
    left, right = matches(turn, shift)
    H_left, H_right = rectifying_homographies(true_matrix(turn, shift), seen(left, right), SIZE)
    rows = [map_pixels(H, uv)[:, 1] for H, uv in ((H_left, left), (H_right, right))]
    assert np.abs(rows[0] - rows[1]).max() < 0.01
    # Of the size of the recorded ones, whichever camera is the left one.
    assert np.ptp(rows[1]) == pytest.approx(np.ptp(right[:, 1]), rel=0.25)


@pytest.mark.parametrize(("turn", "shift"), RIGS)
def test_the_matrix_is_found_and_its_error_shrinks_with_noise(turn, shift) -> None:
    truth = matches(turn, shift)
    errors = []
    for sigma_px in (0.4, 0.1):
        F, agreeing = find_fundamental(seen(*matches(turn, shift, sigma_px)), 2.0)
        assert F is not None
        assert agreeing.mean() > 0.99
        errors.append(np.abs(line_distances(F, *truth)).mean())
    assert errors[0] < 0.2
    assert errors[1] < 0.5 * errors[0]


def test_a_fit_comes_from_far_and_has_rank_two() -> None:
    turn, shift = RIGS[4]
    left, right = matches(turn, shift)
    F = true_matrix(turn, shift)
    rough = F + 2e-3 * np.abs(F) * np.random.default_rng(0).normal(size=(3, 3))
    fitted = fit_fundamental(rough, left, right)
    assert np.abs(line_distances(rough, left, right)).mean() > 0.02
    assert np.abs(line_distances(fitted, left, right)).max() < 1e-6
    assert abs(np.linalg.det(fitted / np.linalg.norm(fitted))) < 1e-12


def test_distances_are_those_to_the_nearest_matching_pixels() -> None:
    """Shift partners across their epipolar lines: half of a shift is mended on either side."""
    turn, shift = RIGS[0]
    left, right = matches(turn, shift)
    apart = line_distances(true_matrix(turn, shift), left, right + np.array([0.0, 0.6]))
    np.testing.assert_allclose(np.abs(apart), 0.6 / np.sqrt(2), rtol=1e-9)


def test_too_few_matches_give_no_matrix() -> None:
    F, agreeing = find_fundamental(seen(np.zeros((5, 2)), np.zeros((5, 2))), 1.0)
    assert F is None
    assert not agreeing.any()
