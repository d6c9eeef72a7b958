"""Disparities and truths from bare arrays."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import ShapeError
from recon.core.values import Disparity, DisparityTruth, Reason

GIVEN = np.array([[5.0, np.nan, np.inf], [0.0, -3.0, 7.5]])


def test_a_disparity_is_made_of_values_alone() -> None:
    made = Disparity.from_values(GIVEN)
    assert made.values.dtype == np.float32
    assert made.valid.tolist() == [[True, False, False], [False, False, True]]
    assert made.values[made.valid].tolist() == [5, 7.5]
    assert made.confidence.tolist() == np.float32([[0.9, 0, 0], [0, 0, 0.9]]).tolist()
    assert set(made.sigma_px[made.valid].tolist()) == {0.25}
    assert np.isnan(made.sigma_px[~made.valid]).all()
    assert set(made.reason[~made.valid].tolist()) == {Reason.AMBIGUOUS}


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.uint8, np.int64])
def test_any_dtype_of_real_numbers_is_taken(dtype: type) -> None:
    made = Disparity.from_values(np.array([[0, 4], [6, 8]], dtype))
    assert made.values[made.valid].tolist() == [4, 6, 8]


def test_lists_and_masked_arrays_are_taken() -> None:
    assert Disparity.from_values([[1, 2], [3, 4]]).valid.all()
    masked = np.ma.masked_greater(np.arange(1.0, 7.0).reshape(2, 3), 4)
    assert Disparity.from_values(masked).valid.sum() == 4


def test_confidence_and_sigma_may_be_given_and_are_read_where_there_is_a_match() -> None:
    sure = np.where(np.isfinite(GIVEN), 0.5, np.nan)
    made = Disparity.from_values(GIVEN, confidence=sure, sigma_px=1)
    assert made.confidence[made.valid].tolist() == [0.5, 0.5]
    assert made.sigma_px[made.valid].tolist() == [1, 1]


@pytest.mark.parametrize(
    ("values", "others", "words"),
    [
        (np.ones((2, 2, 1)), {}, "wrong shape"),
        (np.ones((0, 3)), {}, "wrong shape"),
        ("five", {}, "not an array of real numbers"),
        (np.ones((2, 2), bool), {}, "not an array of real numbers.*bool"),
        (np.ones((2, 2), complex), {}, "not an array of real numbers.*complex"),
        ([[1, 2], [3]], {}, "not an array"),
        (GIVEN, {"confidence": 1.5}, "confidence"),
        (GIVEN, {"confidence": np.nan}, "confidence"),
        (GIVEN, {"confidence": np.ones((3, 2))}, "confidence has the wrong shape"),
        (GIVEN, {"sigma_px": 0}, "sigma_px"),
        (GIVEN, {"sigma_px": np.inf}, "sigma_px"),
    ],
)
def test_what_cannot_be_a_disparity_is_refused(
    values: object, others: dict[str, object], words: str
) -> None:
    with pytest.raises(ShapeError, match=words):
        Disparity.from_values(values, **others)  # type: ignore[arg-type]


def test_a_truth_is_made_of_values_and_a_mask_of_middlebury() -> None:
    levels = np.array([[255, 255, 255], [255, 255, 128]], np.uint8)
    made = DisparityTruth.from_values(GIVEN, levels)
    assert np.isfinite(made.values).tolist() == [[True, False, False], [False, False, True]]
    assert made.nonocc.tolist() == [[True, False, False], [False, False, False]]
    assert DisparityTruth.from_values(GIVEN, levels == 255).nonocc.sum() == 1
    assert DisparityTruth.from_values(GIVEN).nonocc.sum() == 2


@pytest.mark.parametrize("mask", [np.ones((2, 3), np.uint8), np.ones((3, 2), bool), 255])
def test_a_mask_that_is_none_is_refused(mask: object) -> None:
    with pytest.raises(ShapeError, match="no mask of the truth"):
        DisparityTruth.from_values(GIVEN, mask)  # type: ignore[arg-type]
