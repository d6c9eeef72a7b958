"""OpenCV's matchers as baselines: conventions converted, and the same search range as ours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.core.errors import MatchingError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.match.opencv import OpencvMatcher, OpencvSettings

NAMES = ("opencv-bm", "opencv-sgbm")


def shifted_pair(shift_px: int, shape: tuple[int, int] = (60, 160)) -> RectifiedPair:
    """Noise, seen by the right camera ``shift_px`` further left."""
    height, width = shape
    world = np.random.default_rng(3).integers(0, 256, (height, width + 64), dtype=np.uint8)
    world = cv2.GaussianBlur(world, (3, 3), 0)
    left, right = world[:, 32 : 32 + width], world[:, 32 + shift_px : 32 + shift_px + width]
    return RectifiedPair(left, right, stand_in_camera(width, height, 32))


def match(name: str, pair: RectifiedPair, *, pad: bool = True, **settings: object) -> Disparity:
    matcher = OpencvMatcher(OpencvSettings(pad=pad, **settings), semi_global=name == NAMES[1])
    return matcher.match(pair)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shift_px", [0, 7, 20])
def test_a_shift_is_found_in_pixels_wherever_the_right_image_reaches(
    name: str, shift_px: int
) -> None:
    disparity = match(name, shifted_pair(shift_px))
    found = disparity.values[5:-5, shift_px + 5 : -5]
    # A 16th is OpenCV's step; ten of them allow for the bias of its sub-pixel fit.
    assert np.nanmax(np.abs(found - shift_px)) < 10 / 16
    assert np.isfinite(found).mean() > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_without_padding_a_strip_as_wide_as_the_range_is_unknown(name: str) -> None:
    assert not OpencvSettings().pad  # the baseline is OpenCV as it comes
    assert np.isnan(match(name, shifted_pair(7), pad=False).values[:, :31]).all()
    assert np.isfinite(match(name, shifted_pair(7)).values[5:-5, 12:31]).mean() > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_a_negative_range_finds_negative_disparities(name: str) -> None:
    disparity = match(name, shifted_pair(-6), min_disparity_px=-16)
    assert np.nanmedian(disparity.values) == pytest.approx(-6, abs=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_what_opencv_could_not_match_is_nan_with_a_reason(name: str) -> None:
    rng = np.random.default_rng(5)
    left, right = (rng.integers(0, 256, (60, 160), dtype=np.uint8) for _ in range(2))
    disparity = match(name, RectifiedPair(left, right, stand_in_camera(160, 60, 32)))
    assert np.isnan(disparity.values).mean() > 0.5
    assert Reason.AMBIGUOUS in disparity.reason
    assert not (disparity.values < 0).any()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_matched_beside_the_right_image_or_without_an_image(name: str) -> None:
    pair, valid = shifted_pair(20), np.ones((60, 160), dtype=bool)
    valid[:10] = False
    found = match(name, RectifiedPair(pair.left, pair.right, pair.camera, valid=valid))
    there = np.arange(160) - found.values
    assert np.nanmin(there) >= -0.5
    assert np.nanmax(there) <= 159.5
    assert (found.reason[:10] == Reason.BORDER).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (3, 3)])
def test_tiny_images_are_no_error(name: str, shape: tuple[int, int]) -> None:
    image = np.full(shape, 90, np.uint8)
    pair = RectifiedPair(image, image, stand_in_camera(shape[1], shape[0]))
    assert match(name, pair).values.shape == shape


def test_a_refusal_of_opencv_is_an_error_of_ours() -> None:
    pair = shifted_pair(0, (6, 20))
    with pytest.raises(MatchingError, match="20x6"):
        match("opencv-bm", pair, pad=False, block_px=21)


@pytest.mark.parametrize("range_px", [{"min_disparity_px": -4096}, {"ndisp": 4096}])
def test_a_range_beyond_16_bits_is_refused(range_px: dict[str, int]) -> None:
    with pytest.raises(MatchingError, match="exceed the range of OpenCV"):
        match("opencv-sgbm", shifted_pair(0), **range_px)
