"""Confidence metrics of scenes, and their mean, on maps built for the purpose."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.values import Disparity, DisparityTruth, Reason
from recon.evaluation.confidence import share_within_sigma
from recon.evaluation.middlebury.bench import weighted_confidence
from recon.evaluation.middlebury.score import confidence_figures

SHAPE = (60, 100)


def made(
    error_px: np.ndarray | float, confidence: float = 0.8, sigma_px: float = 0.5, truth: float = 20
) -> tuple[Disparity, DisparityTruth]:
    true = np.full(SHAPE, truth, np.float32)
    estimate = Disparity(
        values=(true + error_px).astype(np.float32),
        confidence=np.full(SHAPE, confidence, np.float32),
        sigma_px=np.full(SHAPE, sigma_px, np.float32),
        reason=np.full(SHAPE, Reason.VALID, np.uint8),
    )
    return estimate, DisparityTruth(true, np.ones(SHAPE, bool))


def fifth_wrong() -> np.ndarray:
    return np.where(np.arange(np.prod(SHAPE)).reshape(SHAPE) % 5 == 0, 3.0, 0.25)


def test_confidence_that_is_right_as_often_as_it_says_has_no_error() -> None:
    figures = confidence_figures(*made(fifth_wrong()))
    assert figures is not None
    # 1e-6: confidence is float32.
    assert figures["ece"] == pytest.approx(0, abs=1e-6)
    assert figures["within_1_sigma"] == figures["within_2_sigma"] == pytest.approx(0.8)
    assert figures["reliability"]["right"].count(None) == 9
    assert sum(figures["reliability"]["share"]) == pytest.approx(1)


def test_share_within_sigma_counts_what_is_less_than_it() -> None:
    errors = np.tile(np.array([0.2, 0.7, 1.2, 5.0]), (SHAPE[0], SHAPE[1] // 4))
    estimate, truth = made(errors)
    assert [share_within_sigma(estimate, truth, n) for n in (1, 2, 3)] == [0.25, 0.5, 0.75]


@pytest.mark.parametrize("factor", [2, 4])
def test_a_map_larger_than_the_truth_is_judged_in_its_own_pixels(factor: int) -> None:
    """Off by 0.75 of its own pixels is right; at half the size that is 0.375 px of the truth."""
    estimate, _ = made(0.75, sigma_px=1.0)
    small = tuple(n // factor for n in SHAPE)
    truth = DisparityTruth(np.full(small, 20 / factor, np.float32), np.ones(small, bool))
    figures = confidence_figures(estimate, truth)
    assert figures is not None
    assert figures["reliability"]["right"][8] == 1
    assert figures["within_1_sigma"] == 1
    wrong, _ = made(1.25, sigma_px=1.0)
    figures = confidence_figures(wrong, truth)
    assert figures is not None
    assert figures["reliability"]["right"][8] == 0
    assert figures["within_1_sigma"] == 0


def test_a_map_without_a_value_has_no_figures() -> None:
    estimate, truth = made(0.0)
    nothing = estimate.reject(np.ones(SHAPE, bool), Reason.AMBIGUOUS)
    assert confidence_figures(nothing, truth) is None
    assert weighted_confidence({"Piano": None}) is None


def test_the_mean_counts_scenes_by_weight_and_leaves_out_those_without() -> None:
    """PianoL counts half: two thirds and one third."""
    right, wrong = confidence_figures(*made(0.0)), confidence_figures(*made(5.0))
    mean = weighted_confidence({"Piano": right, "PianoL": wrong, "Teddy": None})
    assert mean is not None
    assert mean["ece"] == pytest.approx(2 / 3 * 0.2 + 1 / 3 * 0.8, abs=1e-6)
    assert mean["within_1_sigma"] == pytest.approx(2 / 3)
    # 1e-5: the lists have six digits.
    assert mean["reliability"]["right"][8] == pytest.approx(2 / 3, abs=1e-5)
    assert mean["sparsification"]["wrong"][0] == pytest.approx(1 / 3, abs=1e-5)
