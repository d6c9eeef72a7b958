from __future__ import annotations

import math

import cv2
import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.report.pair_page import (
    confidence_figure,
    depth_figure,
    depth_marks,
    disparity_figure,
    error_figure,
    pair_figure,
    reasons_figure,
)


def decode(png: bytes) -> UInt8:
    """The image in a PNG, at least 300 pixels wide to be readable."""
    assert png.startswith(b"\x89PNG")
    picture = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 300
    return np.asarray(picture, dtype=np.uint8)


def test_every_figure_of_a_pair_is_a_png(pair: RectifiedPair, disparity: Disparity) -> None:
    decode(pair_figure(pair))
    decode(disparity_figure(disparity, pair.camera))
    decode(confidence_figure(disparity))
    decode(reasons_figure(disparity))
    decode(depth_figure(25.0 / disparity.values))
    decode(error_figure(disparity.values - 2))


def test_figures_without_any_value_are_drawn(pair: RectifiedPair, nothing_found: Disparity) -> None:
    decode(disparity_figure(nothing_found, pair.camera))
    decode(depth_figure(nothing_found.values))
    decode(confidence_figure(nothing_found))
    decode(reasons_figure(nothing_found))
    decode(error_figure(nothing_found.values))


def test_figure_of_a_disparity_below_zero_is_drawn(
    pair: RectifiedPair, disparity: Disparity
) -> None:
    """With doffs, disparities may be negative; they have no depth here, where doffs is 0."""
    below = Disparity(
        disparity.values - 20, disparity.confidence, disparity.sigma_px, disparity.reason
    )
    decode(disparity_figure(below, pair.camera))


def test_a_figure_shows_its_picture(pair: RectifiedPair, disparity: Disparity) -> None:
    picture = decode(disparity_figure(disparity, pair.camera)).astype(int)
    left, right = picture[100, 20], picture[100, -20]
    assert left.max() < 40  # no match: almost black
    assert right[2] > right[0] + 60  # near: red (OpenCV decodes to BGR)


def test_shares_of_reasons_add_up_and_the_largest_comes_first(disparity: Disparity) -> None:
    shares = disparity.reason_shares
    assert shares == {Reason.VALID: 0.75, Reason.BORDER: 0.25}
    assert list(shares) == [Reason.VALID, Reason.BORDER]


def test_depth_marks_are_round_inside_the_range_and_apart() -> None:
    limits = (math.log(3.3), math.log(80.0))
    marks = depth_marks(3.3, 80.0, math.log, limits)
    assert {5.0, 10.0, 20.0, 50.0} <= set(marks)
    assert 3.3 <= min(marks) < max(marks) <= 80.0
    gaps = np.diff(np.log(marks)) / (limits[1] - limits[0])
    assert gaps.min() >= 0.1  # room for a label
