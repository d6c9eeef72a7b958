from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.report.pair_page import (
    depth_marks,
    disparity_figure,
    error_figure,
    is_wide,
    stereo_figures,
)


def decode(png: bytes) -> UInt8:
    """The image in a PNG, at least 300 pixels wide to be readable."""
    assert png.startswith(b"\x89PNG")
    picture = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 300
    return np.asarray(picture, dtype=np.uint8)


@pytest.mark.parametrize("which", ["disparity", "nothing_found", "below zero"])
def test_every_figure_of_a_pair_is_a_png(
    which: str, pair: RectifiedPair, disparity: Disparity, nothing_found: Disparity
) -> None:
    """With doffs, disparities may be negative; they have no depth here, where doffs is 0."""
    below = replace(disparity, values=disparity.values - 20)
    shown = {"disparity": disparity, "nothing_found": nothing_found}.get(which, below)
    figures = stereo_figures(pair, shown)
    assert figures.pop("wide")
    assert figures.pop("valid_percent") == 100 * shown.valid.mean()
    for png in (*figures.values(), error_figure(shown.values)):
        decode(png)


def test_a_figure_shows_its_picture(pair: RectifiedPair, disparity: Disparity) -> None:
    picture = decode(disparity_figure(disparity, pair.camera)).astype(int)
    left, right = picture[100, 20], picture[100, -20]
    assert left.max() < 40  # no match: almost black
    assert right[2] > right[0] + 60  # near: red (OpenCV decodes to BGR)


def test_images_of_twice_their_height_are_wide() -> None:
    assert [is_wide((10, width, 3)) for width in (19, 20)] == [False, True]


def test_shares_of_reasons_add_up_and_the_largest_comes_first(disparity: Disparity) -> None:
    assert [*disparity.reason_shares.items()] == [(Reason.VALID, 0.75), (Reason.BORDER, 0.25)]


def test_depth_marks_are_round_inside_the_range_and_apart() -> None:
    limits = (math.log(3.3), math.log(80.0))
    marks = depth_marks(3.3, 80.0, math.log, limits)
    assert {5.0, 10.0, 20.0, 50.0} <= set(marks)
    assert 3.3 <= min(marks) < max(marks) <= 80.0
    gaps = np.diff(np.log(marks)) / (limits[1] - limits[0])
    assert gaps.min() >= 0.1  # room for a label
    assert len(marks) >= 7
