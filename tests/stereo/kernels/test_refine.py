"""The compiled checks equal their reference, and the codes are those of the values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.kernels.compiled import Bool, Float32, Float64, UInt8, UInt16
from recon.core.values import Reason
from recon.stereo.kernels import refine
from recon.stereo.kernels.minima import NO_COST, Minima
from recon.stereo.kernels.refine import (
    AMBIGUOUS,
    BORDER,
    LEFT_RIGHT,
    LOW_TEXTURE,
    OCCLUDED,
    OUT_OF_RANGE,
    REFINED_BYTES,
    SIGMA_LARGEST_PX,
    VALID,
    WRONG_PX,
    Refined,
    Rules,
    refine_minima,
    refined_in,
    reject,
)

RULES = Rules(8, 0, 0.0, 0, left_right=1, window_pixels=25, sigma_floor_px=0.1)


def refine_all(minima: Minima, texture: np.ndarray, rules: Rules) -> Refined:
    shape = minima.winner.shape
    refined = refined_in(np.empty(REFINED_BYTES * minima.winner.size, np.uint8), *shape)
    refine_minima(minima, texture, rules, 0, len(texture), refined)
    return refined


def one_pixel(costs: tuple[int, int, int, int]) -> Minima:
    """A row of eight pixels whose candidate 3 won with ``costs``."""
    return Minima(
        winner=np.full((1, 8), 3, np.uint16),
        costs=np.tile(np.array(costs, np.uint16)[:, None, None], (1, 1, 8)),
        right_winner=np.full((1, 8), 3, np.uint16),
    )


def refine_one(minima: Minima, rules: Rules = RULES) -> tuple[float, float, float, int]:
    refined = refine_all(minima, np.ones((1, 8), np.float32), rules)
    value, confidence, sigma, reason = (part[0, 5].item() for part in refined)
    return value, confidence, sigma, reason


@st.composite
def cases(draw: st.DrawFn) -> tuple[Minima, np.ndarray, Rules]:
    height, width = draw(st.tuples(st.integers(1, 4), st.integers(1, 9)))
    ndisp, minimum = draw(st.integers(1, 9)), draw(st.integers(-4, 4))
    x = np.arange(width)
    low = np.clip(x - minimum - (width - 1), 0, ndisp)
    high = np.clip(x - minimum, -1, ndisp - 1)
    share = draw(hnp.arrays(np.float64, (height, width), elements=st.floats(0, 1)))
    inside = np.rint(low + share * np.maximum(high - low, 0))
    winner = np.where(low <= high, inside, ndisp)
    cost = st.one_of(st.integers(0, 40), st.just(NO_COST))
    costs = np.sort(draw(hnp.arrays(np.uint16, (4, height, width), elements=cost)), axis=0)
    right = draw(hnp.arrays(np.uint16, (height, width), elements=st.integers(0, ndisp)))
    grey = st.one_of(st.floats(0, 4, width=32), st.just(math.nan))
    texture = draw(hnp.arrays(np.float32, (height, width), elements=grey))
    rules = RULES._replace(
        ndisp=ndisp,
        minimum=minimum,
        fit=draw(st.booleans()),
        texture=draw(st.sampled_from([0.0, 2.0])),
        uniqueness=draw(st.sampled_from([0, 15])),
        left_right=draw(st.integers(-1, 1)),
    )
    return Minima(winner.astype(np.uint16), costs, right), texture, rules


LEFT_RIGHT_OR_OCCLUDED = (
    Minima(
        np.array([[2, 3]], np.uint16), np.zeros((4, 1, 2), np.uint16), np.zeros((1, 2), np.uint16)
    ),
    np.zeros((1, 2), np.float32),
    RULES._replace(ndisp=3, minimum=-3, left_right=0, fit=False),
)
"""Once found by chance, where the kernel and its reference gave different reasons."""


@given(cases())
@example(LEFT_RIGHT_OR_OCCLUDED)
def test_refinement_equals_its_reference(case: tuple[Minima, np.ndarray, Rules]) -> None:
    found, expected = refine_all(*case), refine_minima_reference(*case)
    np.testing.assert_array_equal(found.reason, expected.reason)
    # The kernel computes in float32, its reference in float64. Costs are exact in both.
    u = 2.0**-24
    # An offset of 1 at most (two operations), added to a candidate below 13 (the third).
    np.testing.assert_allclose(found.values, expected.values, rtol=0, atol=(2 + 13) * u)
    # Odds: 5 operations for sigma, its cube 17, the margin's 2; half of these under the root, and
    # 3 more. What odds are off by is so much of the confidence, or less; the quotient adds 2.
    np.testing.assert_allclose(found.confidence, expected.confidence, rtol=0, atol=16 * u)
    # The variance is off by so much of that of a wrong disparity, and by 12 operations of its own.
    wrong = np.maximum(expected.sigma_px, WRONG_PX) ** 2
    variance_off = 16 * u * wrong + 12 * u * expected.sigma_px**2
    known = expected.reason == refine.VALID
    sigma_off = np.abs(found.sigma_px - expected.sigma_px)[known]
    bound = variance_off / (2 * expected.sigma_px) + 2 * u * expected.sigma_px
    assert (sigma_off <= bound[known]).all()


@given(cases())
def test_results_lie_within_their_bounds(case: tuple[Minima, np.ndarray, Rules]) -> None:
    minima, _, rules = case
    refined = refine_all(*case)
    kept = refined.reason == refine.VALID
    np.testing.assert_array_equal(np.isfinite(refined.values), kept)
    np.testing.assert_array_equal(np.isfinite(refined.sigma_px), kept)
    assert (refined.confidence[~kept] == 0).all()
    assert ((refined.confidence >= 0) & (refined.confidence <= 1)).all()
    # The floor is float64 in the rules and float32 in the result.
    assert (refined.sigma_px[kept] >= np.float32(rules.sigma_floor_px)).all()
    assert (refined.sigma_px[kept] <= refine.SIGMA_LARGEST_PX).all()
    whole = minima.winner[kept] + float(rules.minimum)
    assert (np.abs(refined.values[kept] - whole) <= 0.5).all()


def test_codes_are_those_of_the_values() -> None:
    for reason in set(Reason) - {Reason.SPECKLE, Reason.EDGE}:
        assert getattr(refine, reason.name) == reason


def test_vertex_of_two_equal_slopes_is_found_exactly() -> None:
    # Costs of |d - 3.25| · 40 + 10 at 2, 3 and 4.
    value, _, _, reason = refine_one(one_pixel((20, 60, 40, 100)))
    assert reason == Reason.VALID
    assert value == 3.25


def test_confidence_is_the_odds_of_margin_and_noise() -> None:
    _, confidence, _, _ = refine_one(one_pixel((20, 60, 40, 100)), RULES._replace(odds=3.0))
    margin = (100 - 20) / (25 + 20)
    # Slope 40, vertex 10, 25 pixels; the floor is 0.1.
    noise_px = 0.5 * np.pi * 10 / (40 * 5)
    sigma_px = np.hypot(0.1, noise_px)
    # 1e-5: float32.
    assert confidence / (1 - confidence) == pytest.approx(
        3 * (margin / sigma_px**3) ** 0.5, rel=1e-5
    )


@pytest.mark.parametrize(("costs", "sigma_px"), [((20, 20, 20, 100), 2.0), ((0, 50, 50, 100), 0.1)])
def test_sigma_is_the_limit_without_slope_and_the_floor_without_noise_or_doubt(
    costs: tuple[int, int, int, int], sigma_px: float
) -> None:
    # 1e-4: with such odds the confidence is 1 to float32, and 1e-9 short of it.
    sure = RULES._replace(odds=1e9)
    assert refine_one(one_pixel(costs), sure)[2] == pytest.approx(sigma_px, abs=1e-4)


def test_rejected_pixels_have_nothing_left_but_a_reason() -> None:
    refined = refine_all(one_pixel((2, 6, 6, 20)), np.ones((1, 8), np.float32), RULES)
    mask = np.arange(8)[None] >= 6
    reject(mask, int(Reason.SPECKLE), refined)
    np.testing.assert_array_equal(refined.reason == Reason.SPECKLE, mask)
    assert np.isnan(refined.values[mask]).all()
    assert np.isnan(refined.sigma_px[mask]).all()
    assert (refined.confidence[mask] == 0).all()
    assert np.isfinite(refined.values[0, 5])


def refine_minima_reference(minima: Minima, texture: Float32, rules: Rules) -> Refined:
    """Return all rows of `recon.stereo.kernels.refine.refine_minima`."""
    reason = _reasons(minima, texture, rules)
    keep = reason == VALID
    best, before, after, second = minima.costs.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = rules.minimum + minima.winner.astype(np.float64)
        values += _offsets(best, before, after, rules.fit)
        sigma = _sigmas(best, before, after, rules)
        margin = (second - best) / (rules.window_pixels + best)
        odds = rules.odds * np.sqrt(margin / (sigma * sigma * sigma))
        confidence = np.where(second < NO_COST, odds / (odds + 1.0), 0.0)
        if_wrong = np.maximum(sigma, WRONG_PX)
        mixed = np.sqrt(confidence * sigma**2 + (1.0 - confidence) * if_wrong**2)
    return Refined(
        values=np.where(keep, values, np.nan).astype(np.float32),
        confidence=np.where(keep, confidence, 0.0).astype(np.float32),
        sigma_px=np.where(keep, mixed, np.nan).astype(np.float32),
        reason=reason,
    )


def _reasons(minima: Minima, texture: Float32, rules: Rules) -> UInt8:
    k = minima.winner.astype(np.int64)
    best, before, after, second = minima.costs.astype(np.int64)
    width = k.shape[1]
    right = np.arange(width) - rules.minimum - k
    place = np.clip(right, 0, width - 1)
    other = np.take_along_axis(minima.right_winner.astype(np.int64), place, axis=1)
    differs = (rules.left_right >= 0) & (np.abs(other - k) > rules.left_right)
    inside = (right > 0) & (right < width - 1)
    chosen = _chosen_beside(minima.right_winner, rules)
    ends = np.maximum(before, after) == NO_COST
    close = 100 * second <= best * (100 + rules.uniqueness)
    cases = [
        ((k == rules.ndisp) | np.isnan(texture), BORDER),
        (texture < rules.texture, LOW_TEXTURE),
        (ends & ((k == 0) | (k == rules.ndisp - 1) | inside), OUT_OF_RANGE),
        (ends, BORDER),
        (differs & chosen, LEFT_RIGHT),
        (differs, OCCLUDED),
        ((rules.uniqueness > 0) & close, AMBIGUOUS),
    ]
    conditions, codes = zip(*cases, strict=True)
    return np.asarray(np.select(conditions, codes, VALID), dtype=np.uint8)


def _chosen_beside(right_winner: UInt16, rules: Rules) -> Bool:
    height, width = right_winner.shape
    x = np.arange(width) + rules.minimum + right_winner.astype(np.int64)
    chosen = np.zeros((height, width), np.bool_)
    for aside in (-1, 0, 1):
        seen = (right_winner != rules.ndisp) & (x + aside >= 0) & (x + aside < width)
        chosen[np.nonzero(seen)[0], (x + aside)[seen]] = True
    return chosen


def _offsets(best: Float64, before: Float64, after: Float64, fit: bool) -> Float64:
    slope = np.maximum(before, after) - best
    return np.where(fit & (slope > 0), 0.5 * (before - after) / slope, 0.0)


def _sigmas(best: Float64, before: Float64, after: Float64, rules: Rules) -> Float64:
    slope = np.maximum(before, after) - best
    vertex = np.maximum(best - 0.5 * np.abs(before - after), 0.0)
    noise = 0.5 * np.pi * vertex / (slope * np.sqrt(rules.window_pixels))
    sigma = np.sqrt(rules.sigma_floor_px**2 + noise * noise)
    return np.where(slope > 0, np.minimum(sigma, SIGMA_LARGEST_PX), SIGMA_LARGEST_PX)
