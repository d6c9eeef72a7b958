"""Reliability and sparsification on maps with a correct, wrong or useless confidence."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import EvaluationError
from recon.core.values import Disparity, DisparityTruth, Reason
from recon.evaluation.confidence import measure_reliability, measure_sparsification

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


def honest() -> tuple[Disparity, DisparityTruth]:
    """Pixels that are right just as often as their confidence says."""
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0, 1, SHAPE)
    return make_map(confidence, np.where(rng.uniform(0, 1, SHAPE) < confidence, 0.5, 5.0))


def test_honest_confidence_has_no_calibration_error() -> None:
    reliability = measure_reliability(*honest())
    # 10 000 pixels in a bin: a standard deviation of 0.005 or less.
    assert 0 < reliability.calibration_error < 0.01
    np.testing.assert_allclose(reliability.right, reliability.confidence, atol=0.02)
    assert reliability.pixels.sum() == SHAPE[0] * SHAPE[1]


@pytest.mark.parametrize(("claimed", "error_px", "gap"), [(0.9, 5.0, 0.9), (0.25, 0.0, 0.75)])
def test_calibration_error_is_the_gap(claimed: float, error_px: float, gap: float) -> None:
    reliability = measure_reliability(*make_map(np.full((4, 5), claimed), error_px))
    # 1e-6: confidence is float32.
    assert reliability.calibration_error == pytest.approx(gap, abs=1e-6)
    assert np.isnan(reliability.right).sum() == 9


def test_certain_pixels_fall_into_the_last_bin() -> None:
    assert measure_reliability(*make_map(np.ones((2, 3)), 0.0)).pixels[-1] == 6


def test_pixel_off_by_the_limit_is_right() -> None:
    assert measure_reliability(*make_map(np.ones((2, 3)), 1.0)).calibration_error == 0


def test_confidence_that_sorts_perfectly_leaves_no_area() -> None:
    error_px = np.where(np.arange(1000).reshape(10, 100) < 300, 5.0, 0.0)
    curves = measure_sparsification(*make_map(np.where(error_px > 1, 0.2, 0.8), error_px))
    assert curves.ause == pytest.approx(0, abs=1e-12)
    assert curves.wrong[0] == pytest.approx(0.3)
    # 0.7 of the pixels are right: nothing wrong is left once the 0.3 are gone.
    assert not curves.wrong[31:].any()


def test_constant_confidence_gains_nothing() -> None:
    error_px = np.where(np.arange(1000).reshape(10, 100) < 300, 5.0, 0.0)
    curves = measure_sparsification(*make_map(np.full(error_px.shape, 0.5), error_px))
    np.testing.assert_allclose(curves.wrong, 0.3, atol=1e-12)


def test_confidence_upside_down_is_worse_than_a_constant_one() -> None:
    error_px = np.where(np.arange(1000).reshape(10, 100) < 300, 5.0, 0.0)
    areas = [
        measure_sparsification(*make_map(confidence, error_px)).ause
        for confidence in (np.full(error_px.shape, 0.5), np.where(error_px > 1, 0.8, 0.2))
    ]
    assert 0 < areas[0] < areas[1] < 1


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
