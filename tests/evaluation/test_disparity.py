"""Disparity metrics, checked by hand and against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import EvaluationError
from recon.core.values import Disparity, DisparityTruth
from recon.evaluation.disparity import evaluate_disparity
from recon.evaluation.middlebury.score import evaluate_middlebury

NAN = float("nan")


def truth(values: list[float], nonocc: list[bool] | None = None) -> DisparityTruth:
    array = np.array([values], dtype=np.float32)
    seen = np.ones(array.shape, dtype=bool) if nonocc is None else np.array([nonocc])
    return DisparityTruth(array, seen)


def estimate(values: list[float]) -> np.ndarray:
    return np.array([values], dtype=np.float32)


def test_a_case_counted_by_hand() -> None:
    # Errors 0, 0.5, 1, 3, none; the sixth truth is unknown, the seventh occluded.
    given = (
        estimate([10, 10.5, 9, 13, NAN, 4, 90]),
        truth([10, 10, 10, 10, 10, NAN, 10], [True] * 6 + [False]),
    )
    result = evaluate_disparity(*given)
    assert result.pixels == 5
    assert result.bad == pytest.approx({0.5: 40.0, 1.0: 20.0, 2.0: 20.0, 4.0: 0.0})
    assert result.invalid == pytest.approx(20.0)
    assert result.avgerr_px == pytest.approx(4.5 / 4)
    assert result.rms_px == pytest.approx(np.sqrt((0.25 + 1 + 9) / 4))
    # One of six is off by more than 4 px when occluded ones count; 3 px are not more than 3.
    assert evaluate_disparity(*given, occluded=True).bad[4.0] == pytest.approx(100 / 6)
    assert evaluate_disparity(*given, (3.0,)).bad == {3.0: 0.0}
    # KITTI's outliers are off by three pixels, and by a twentieth.
    found, true = estimate([13.5, 13, 103.5, 106, NAN]), truth([10, 10, 100, 100, 9])
    assert evaluate_disparity(found, true).d1 == pytest.approx(40.0)


def test_maps_without_values_or_truth_or_of_another_size_have_no_errors() -> None:
    result = evaluate_disparity(estimate([NAN, NAN]), truth([1, 2]))
    assert (result.invalid, set(result.bad.values())) == (100, {0.0})
    assert np.isnan([result.avgerr_px, result.rms_px]).all()
    with pytest.raises(EvaluationError, match="differ in size"):
        evaluate_disparity(estimate([1, 2]), truth([1]))
    with pytest.raises(EvaluationError, match="no pixel has a known truth"):
        evaluate_disparity(estimate([1]), truth([NAN]))


@given(st.integers(0, 2**16))
def test_bad_falls_with_the_threshold_and_shares_stay_shares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(20, 3, (6, 9)).astype(np.float32)
    values[rng.random(values.shape) < 0.3] = np.nan
    known = DisparityTruth(np.full((6, 9), 20, np.float32), rng.random((6, 9)) < 0.9)
    result = evaluate_disparity(values, known)
    bad = [result.bad[t] for t in sorted(result.bad)]
    assert bad == sorted(bad, reverse=True)
    assert 0 <= bad[0] + result.invalid <= 100 + 1e-9
    if np.isfinite(result.rms_px):
        assert result.avgerr_px <= result.rms_px + 1e-9


def test_quantiles_are_errors_that_occur() -> None:
    errors = np.arange(100, 0, -1, dtype=np.float32)[None]
    known = DisparityTruth(np.zeros_like(errors), np.ones(errors.shape, dtype=bool))
    assert evaluate_disparity(errors, known).quantiles_px == {50: 50, 90: 90, 95: 95, 99: 99}


def test_figures_of_the_full_size_are_those_of_maps_enlarged() -> None:
    small = evaluate_disparity(estimate([10.25, 12, 9]), truth([10, 10, 10]), scale=4)
    large = evaluate_disparity(estimate([41, 48, 36]), truth([40, 40, 40]))
    assert small == large


def test_plain_arrays_are_evaluated_like_values() -> None:
    true = np.array([[8.0, np.inf, 0.0, 6.0], [4.0, 5.0, np.nan, 7.0]])
    found = np.array([[8.5, 3.0, 3.0, np.inf], [9.0, 5.0, 1.0, np.nan]])
    expected = evaluate_disparity(
        found.astype(np.float32), DisparityTruth.from_values(true.astype(np.float32))
    )
    for estimate in (found, found.tolist(), Disparity.from_values(found)):
        got = evaluate_disparity(estimate, true)
        assert got == expected
    # Of five known pixels two have no value, and one is off by 5.
    assert (got.pixels, got.invalid, got.bad[2.0]) == (5, 40, 20)
    assert evaluate_middlebury(found, true) == expected
    assert evaluate_middlebury(Disparity.from_values(found), true.tolist()) == expected
