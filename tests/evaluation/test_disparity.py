"""Errors of disparities, depths and confidences, counted by hand and against definitions."""

import math

import numpy as np
import pytest

from recon.core.errors import EvaluationError
from recon.core.values import Disparity, DisparityTruth, Reason, RectifiedCamera
from recon.evaluation.disparity import (
    evaluate_depth,
    evaluate_disparity,
    evaluate_kinds,
    measure_reliability,
    measure_sparsification,
    ratio_within_sigma,
)

N = float("nan")


def truth(values: list[float], nonocc: list[bool] | None = None) -> DisparityTruth:
    seen = np.array([nonocc or [True] * len(values)])
    return DisparityTruth(np.array([values], dtype=np.float32), seen)


def estimate(values: list[float]) -> np.ndarray:
    return np.array([values], dtype=np.float32)


def test_disparities_and_depths_of_a_case_counted_by_hand():
    # Errors 0, 0.5, 1, 3, none; the sixth truth is unknown, the seventh occluded.
    given = (
        estimate([10, 10.5, 9, 13, N, 4, 90]),
        truth([10, 10, 10, 10, 10, N, 10], [True] * 6 + [False]),
    )
    result = evaluate_disparity(*given)
    assert result.pixels == 5
    assert result.bad == pytest.approx({0.5: 40.0, 1.0: 20.0, 2.0: 20.0, 4.0: 0.0})
    assert (result.invalid, result.avgerr_px) == (pytest.approx(20.0), pytest.approx(4.5 / 4))
    assert result.rms_px == pytest.approx(np.sqrt((0.25 + 1 + 9) / 4))
    # One of six is off by more than 4 px when occluded ones count; 3 px are not more than 3.
    assert evaluate_disparity(*given, occluded=True).bad[4.0] == pytest.approx(100 / 6)
    assert evaluate_disparity(*given, (3.0,)).bad == {3.0: 0.0}
    # KITTI's outliers are off by three pixels, and by a twentieth.
    found, true = estimate([13.5, 13, 103.5, 106, N]), truth([10, 10, 100, 100, 9])
    assert evaluate_disparity(found, true).d1 == pytest.approx(40.0)
    # f·b = 10, doffs 1: disparities 1, 4, 9 are 5 m, 2 m, 1 m.
    camera = RectifiedCamera(100.0, 1.0, 0.0, 2.0, 0.1, 4, 1)
    found = evaluate_depth(estimate([4, 4, -1, N]), truth([1, 4, 9, 9]), camera)
    assert (found.mean_m, found.median_m) == pytest.approx((1.5, 3.0))
    assert found.rms_m == pytest.approx(math.sqrt(4.5))
    assert found.median_percent == pytest.approx(60.0)
    assert (found.over_5_percent, found.infinite) == pytest.approx((200 / 3, 100 / 3))


def test_maps_without_values_or_truth_or_of_another_size_have_no_errors():
    result = evaluate_disparity(estimate([N, N]), truth([1, 2]))
    assert (result.invalid, set(result.bad.values())) == (100, {0.0})
    assert np.isnan([result.avgerr_px, result.rms_px, *result.quantiles_px.values()]).all()
    with pytest.raises(EvaluationError, match="differ in size"):
        evaluate_disparity(estimate([1, 2]), truth([1]))
    for measure in (evaluate_disparity, measure_reliability, measure_sparsification):
        with pytest.raises(EvaluationError, match="no pixel has a known truth"):
            measure(Disparity.from_values(estimate([1])), truth([N]))
    with pytest.raises(EvaluationError, match="both a disparity and a known truth"):
        ratio_within_sigma(Disparity.from_values(estimate([N, 1])), truth([1, N]))


def test_each_kind_of_pixel_is_compared_alone():
    # Measured: off by 0, 0.75, none with truth; inferred: off by 5, 3 (occluded); nothing.
    values = estimate([10, 10.75, 4, 15, 13, N])
    reason = np.array([[0, 0, 0, Reason.FILLED, Reason.FILLED, Reason.LOW_TEXTURE]], np.uint8)
    known = np.isfinite(values)
    both = Disparity(values, known.astype(np.float32), values, reason)
    true = truth([10, 10, N, 10, 10, 10], [True] * 4 + [False, True])
    measured = evaluate_disparity(both, true, kind="measured")
    assert (measured.pixels, measured.invalid, measured.avgerr_px) == (2, 0, 0.375)
    assert measured.bad == {0.5: 50, 1.0: 0, 2.0: 0, 4.0: 0}
    inferred = evaluate_disparity(both, true, kind="inferred", occluded=True)
    assert (inferred.pixels, inferred.invalid, inferred.bad[4.0]) == (2, 0, 50)
    assert evaluate_disparity(both, true).pixels == 4
    by_kind = evaluate_kinds(both, true)
    assert by_kind["measured"] == measured
    assert by_kind["inferred"].bad[4.0] == 100
    assert [*evaluate_kinds(both.only_measured(), true)] == ["measured"]
    assert [*evaluate_kinds(both.only_inferred(), true)] == ["inferred"]


def test_a_kind_that_is_not_there_or_that_there_is_not_is_refused():
    plain, true = estimate([10, N]), truth([9, 9])
    assert evaluate_disparity(plain, true, kind="measured").pixels == 1
    for found in (plain, Disparity.from_values(plain)):
        with pytest.raises(EvaluationError, match="no inferred pixel has a known truth"):
            evaluate_disparity(found, true, kind="inferred")
        with pytest.raises(EvaluationError, match=r"no such kind.*seen.*all, measured"):
            evaluate_disparity(found, true, kind="seen")  # type: ignore[arg-type]


def made(error_px, confidence=0.8):
    """A map off by ``error_px`` from a truth of 20 px."""
    values = np.full(error_px.shape, 20, np.float32)
    estimate = Disparity(
        values=(values + error_px).astype(np.float32),
        confidence=np.broadcast_to(confidence, values.shape).astype(np.float32),
        sigma_px=np.full(values.shape, 0.5, np.float32),
        reason=np.full(values.shape, Reason.VALID, np.uint8),
    )
    return estimate, DisparityTruth(values, np.ones(values.shape, bool))


def test_share_within_sigma_and_honest_confidence_are_counted():
    pair = made(np.array([[0.2, 0.7, 1.2, 5.0]]))
    assert [ratio_within_sigma(*pair, n) for n in (1, 2, 3)] == [0.25, 0.5, 0.75]
    # Pixels are right just as often as their confidence says.
    rng, shape = np.random.default_rng(0), (200, 500)
    confidence = rng.uniform(0, 1, shape)
    error_px = np.where(rng.uniform(0, 1, shape) < confidence, 0.5, 5.0)
    reliability = measure_reliability(*made(error_px, confidence))
    # 10 000 pixels in a bin: a standard deviation of 0.005 or less.
    assert 0 < reliability.calibration_error < 0.01
    np.testing.assert_allclose(reliability.right, reliability.confidence, atol=0.02)
    assert reliability.pixels.sum() == confidence.size


@pytest.mark.parametrize(
    ("claimed", "error_px", "gap", "place"),
    [(0.9, 5.0, 0.9, 8), (0.25, 0.0, 0.75, 2), (1.0, 1.0, 0.0, 9)],
)
def test_calibration_error_is_the_gap(claimed, error_px, gap, place):
    """A pixel off by the limit is right; what is certain falls into the last bin."""
    reliability = measure_reliability(*made(np.full((4, 5), error_px), claimed))
    # 1e-6: confidence is float32, in which 0.9 is a little less.
    assert reliability.calibration_error == pytest.approx(gap, abs=1e-6)
    assert np.flatnonzero(reliability.pixels).tolist() == [place]
    assert np.flatnonzero(~np.isnan(reliability.right)).tolist() == [place]


def test_confidence_that_sorts_better_leaves_less_area():
    error_px = np.where(np.arange(1000).reshape(10, 100) < 300, 5.0, 0.0)
    best, flat, worst = (
        measure_sparsification(*made(error_px, np.where(error_px > 1, wrong, right)))
        for wrong, right in ((0.2, 0.8), (0.5, 0.5), (0.8, 0.2))
    )
    assert (best.ause, best.wrong[0]) == (pytest.approx(0, abs=1e-12), pytest.approx(0.3))
    # 0.7 of the pixels are right: nothing wrong is left once the 0.3 are gone.
    assert not best.wrong[31:].any()
    assert best.wrong[:30].all()
    np.testing.assert_allclose(flat.wrong, 0.3, atol=1e-12)
    assert 0 < flat.ause < worst.ause < 1
