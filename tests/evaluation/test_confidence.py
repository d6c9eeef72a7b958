"""Reliability and sparsification on maps with a correct, wrong or useless confidence."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import EvaluationError
from recon.core.values import Disparity, DisparityTruth, Reason
from recon.evaluation.disparity import measure_reliability, measure_sparsification

SHAPE = (200, 500)


def make_map(
    confidence: np.ndarray, error_px: np.ndarray | float
) -> tuple[Disparity, DisparityTruth]:
    """A map off by ``error_px`` from a truth of 20 px."""
    truth = np.full(confidence.shape, 20, np.float32)
    estimate = Disparity(
        values=(truth + error_px).astype(np.float32),
        confidence=confidence.astype(np.float32),
        sigma_px=np.full(truth.shape, 0.1, np.float32),
        reason=np.full(truth.shape, Reason.VALID, np.uint8),
    )
    return estimate, DisparityTruth(truth, np.ones(truth.shape, bool))


def test_honest_confidence_has_no_calibration_error() -> None:
    """Pixels are right just as often as their confidence says."""
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0, 1, SHAPE)
    error_px = np.where(rng.uniform(0, 1, SHAPE) < confidence, 0.5, 5.0)
    reliability = measure_reliability(*make_map(confidence, error_px))
    # 10 000 pixels in a bin: a standard deviation of 0.005 or less.
    assert 0 < reliability.calibration_error < 0.01
    np.testing.assert_allclose(reliability.right, reliability.confidence, atol=0.02)
    assert reliability.pixels.sum() == SHAPE[0] * SHAPE[1]


@pytest.mark.parametrize(
    ("claimed", "error_px", "gap", "place"),
    [(0.9, 5.0, 0.9, 8), (0.25, 0.0, 0.75, 2), (1.0, 1.0, 0.0, 9)],
)
def test_calibration_error_is_the_gap(
    claimed: float, error_px: float, gap: float, place: int
) -> None:
    """A pixel off by the limit is right; what is certain falls into the last bin."""
    reliability = measure_reliability(*make_map(np.full((4, 5), claimed), error_px))
    # 1e-6: confidence is float32, in which 0.9 is a little less.
    assert reliability.calibration_error == pytest.approx(gap, abs=1e-6)
    assert np.flatnonzero(reliability.pixels).tolist() == [place]
    assert np.flatnonzero(~np.isnan(reliability.right)).tolist() == [place]


def test_confidence_that_sorts_better_leaves_less_area() -> None:
    error_px = np.where(np.arange(1000).reshape(10, 100) < 300, 5.0, 0.0)
    best, flat, worst = (
        measure_sparsification(*make_map(np.where(error_px > 1, wrong, right), error_px))
        for wrong, right in ((0.2, 0.8), (0.5, 0.5), (0.8, 0.2))
    )
    assert best.ause == pytest.approx(0, abs=1e-12)
    assert best.wrong[0] == pytest.approx(0.3)
    # 0.7 of the pixels are right: nothing wrong is left once the 0.3 are gone.
    assert not best.wrong[31:].any()
    assert best.wrong[:30].all()
    np.testing.assert_allclose(flat.wrong, 0.3, atol=1e-12)
    assert 0 < flat.ause < worst.ause < 1


@pytest.mark.parametrize("measure", [measure_reliability, measure_sparsification])
def test_maps_that_cannot_be_compared_are_refused(measure: object) -> None:
    assert callable(measure)
    estimate, truth = make_map(np.ones((2, 3)), 0.0)
    _, larger = make_map(np.ones((3, 3)), 0.0)
    with pytest.raises(EvaluationError, match="differ in size"):
        measure(estimate, larger)
    unknown = DisparityTruth(np.full((2, 3), np.nan, np.float32), truth.nonocc)
    with pytest.raises(EvaluationError, match="no pixel"):
        measure(estimate, unknown)
