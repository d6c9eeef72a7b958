"""Middlebury's metrics against a plain implementation of the SDK's definitions, pixel by pixel."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import EvaluationError
from recon.core.values import DisparityTruth, RectifiedCamera
from recon.evaluation.disparity import evaluate_depth
from recon.evaluation.middlebury.score import (
    MiddleburyRules,
    at_truth_size,
    evaluate_middlebury,
    scene_weight,
    weighted_mean,
)

N = float("nan")


def plain_figures(
    disp: np.ndarray, gt: np.ndarray, mask: np.ndarray | None, ndisp: int, rounded: bool, full: int
) -> dict[str, float]:
    """What SDK 1.6 describes, in loops: infinity is unknown, limits are in full-size pixels."""
    scale = gt.shape[1] // disp.shape[1]
    n = invalid = 0
    errors = []
    for y in range(gt.shape[0]):
        for x in range(gt.shape[1]):
            if math.isinf(gt[y, x]) or (mask is not None and mask[y, x] != 255):
                continue
            n += 1
            d = scale * float(disp[y // scale, x // scale])
            if math.isinf(d):
                invalid += 1
                continue
            d = max(0.0, min(float(scale * ndisp), d))
            if rounded:
                d = math.floor(d + 0.5)
            errors.append(abs(d - float(gt[y, x])) * full)
    errors.sort()
    figures = {f"bad{t}": 100 * sum(e > t for e in errors) / n for t in (0.5, 1, 2, 4)}
    figures["invalid"] = 100 * invalid / n
    figures["avgerr"] = sum(errors) / len(errors)
    figures["rms"] = math.sqrt(sum(e * e for e in errors) / len(errors))
    for q in (50, 90, 95, 99):
        figures[f"a{q}"] = errors[math.ceil(q / 100 * len(errors)) - 1]
    return figures


@given(
    seed=st.integers(0, 2**16),
    scale=st.sampled_from([1, 2, 4]),
    full=st.sampled_from([1, 2, 4]),
    rounded=st.booleans(),
    masked=st.booleans(),
)
def test_figures_are_those_of_the_plain_definitions(
    seed: int, scale: int, full: int, rounded: bool, masked: bool
) -> None:
    rng = np.random.default_rng(seed)
    # Multiples of 1/4 are exact, so errors of exactly a limit occur and must not be bad.
    gt = (rng.integers(0, 80 * scale, (12, 16)) / 4).astype(np.float32)
    small = gt[::scale, ::scale] / scale + rng.integers(-12, 13, (12 // scale, 16 // scale)) / 4
    disp = small.astype(np.float32)
    disp[rng.random(disp.shape) < 0.2] = np.inf
    disp[0, 0] = 3.0
    gt[rng.random(gt.shape) < 0.2] = np.inf
    gt[0, 0] = 3.0
    mask = np.where(rng.random(gt.shape) < 0.8, 255, 128)
    mask[0, 0] = 255
    expected = plain_figures(disp, gt, mask if masked else None, 20, rounded, full)

    truth = DisparityTruth(np.where(np.isinf(gt), np.float32(np.nan), gt), mask == 255)
    rules = MiddleburyRules(full_size_factor=full, largest_px=20.0 * scale, isint=rounded)
    values = np.where(np.isinf(disp), np.float32(np.nan), disp)
    found = evaluate_middlebury(values, truth, rules, occluded=not masked)

    named = {f"bad{t:g}": share for t, share in found.bad.items()}
    named |= {"invalid": found.invalid, "avgerr": found.avgerr_px, "rms": found.rms_px}
    named |= {f"a{q}": error for q, error in found.quantiles_px.items()}
    # float32 in, float64 sums: what differs is the order of addition.
    assert named == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_result_is_taken_to_the_size_of_the_truth_up_to_the_rest_of_a_division() -> None:
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    assert at_truth_size(values, (2, 3)).tolist() == [[0, 1, 2], [6, 7, 8]]
    smaller = at_truth_size(np.array([[1, N]], dtype=np.float32), (2, 4))
    assert np.array_equal(smaller, [[2, 2, N, N], [2, 2, N, N]], equal_nan=True)
    for shape in ((5, 7), (6, 8), (5, 8)):
        assert at_truth_size(np.ones(shape, np.float32), (3, 4)).shape == (3, 4)


def test_sizes_that_are_no_multiples_are_refused() -> None:
    with pytest.raises(EvaluationError, match="differ in size"):
        at_truth_size(np.ones((10, 10), np.float32), (10, 15))


def test_five_scenes_count_half() -> None:
    halved = {"PianoL", "Playroom", "Playtable", "Shelves", "Vintage"}
    assert all(scene_weight(name) == 4 for name in halved)
    assert scene_weight("PlaytableP") == scene_weight("Piano") == scene_weight("Teddy") == 8
    assert weighted_mean({"Teddy": 10.0, "Vintage": 40.0}) == pytest.approx(20.0)
    assert scene_weight("trainingQ/Playroom") == 4


def test_depth_errors_of_a_case_counted_by_hand() -> None:
    # f·b = 10, doffs 1: disparities 1, 4, 9 are 5 m, 2 m, 1 m.
    camera = RectifiedCamera(100.0, 1.0, 0.0, 2.0, 0.1, 4, 1)
    truth = DisparityTruth(np.array([[1, 4, 9, 9]], np.float32), np.ones((1, 4), dtype=bool))
    values = np.array([[4, 4, -1, N]], np.float32)
    found = evaluate_depth(values, truth, camera)
    assert found.mean_m == pytest.approx(1.5)
    assert found.rms_m == pytest.approx(math.sqrt(4.5))
    assert found.median_m == pytest.approx(3.0)
    assert found.median_percent == pytest.approx(60.0)
    assert found.over_5_percent == pytest.approx(200 / 3)
    assert found.infinite == pytest.approx(100 / 3)
