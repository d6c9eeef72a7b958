"""Block matching as printed: what it finds, and what its missing absolute value does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.errors import MatchingError
from recon.core.values import Reason, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float32, UInt8
from recon.evaluation.paper.printed import match_as_printed
from tests.scenery.planes import fronto_parallel_pair


def camera_for(width_px: int, height_px: int, ndisp: int | None = None) -> RectifiedCamera:
    middle = (width_px / 2, height_px / 2, width_px / 2)
    return RectifiedCamera(60.0, *middle, 0.5, width_px, height_px, ndisp)


def match(
    left: UInt8, right: UInt8, patch_px: int, *, signed: bool = True, ndisp: int | None = None
) -> Float32:
    height, width = left.shape
    pair = RectifiedPair(left, right, camera_for(width, height, ndisp))
    return match_as_printed(pair, patch_px, signed=signed).values


def test_absolute_differences_find_a_wall_to_the_whole_pixel() -> None:
    # 60 px · 0.5 m / 5 m = 6 px exactly.
    scene = fronto_parallel_pair(camera_for(64, 40, 16), 5.0)
    found = match_as_printed(scene.pair, 7, signed=False)
    seen = found.valid.copy()
    seen[:, : 6 + 3] = False  # there the right image does not show the patch
    assert np.mean(found.values[seen] == 6) > 0.99
    assert np.all(found.values[found.valid] == np.rint(found.values[found.valid]))


def test_signed_differences_do_not_find_the_wall() -> None:
    scene = fronto_parallel_pair(camera_for(64, 40, 16), 5.0)
    found = match_as_printed(scene.pair, 7, signed=True)
    assert np.mean(found.values[:, 9:-3] == 6) < 0.3


def test_the_least_signed_sum_is_the_brightest_patch_of_the_right_image() -> None:
    left = np.full((9, 30), 100, dtype=np.uint8)
    right = np.full((9, 30), 50, dtype=np.uint8)
    right[:, 10] = 200
    assert match(left, right, patch_px=1, ndisp=16)[4, 15] == 5
    assert match(left, left, patch_px=1, ndisp=16)[4, 15] == 0


def test_only_pixels_whose_patch_leaves_the_image_have_no_value() -> None:
    left = np.random.default_rng(0).integers(0, 256, (20, 30), dtype=np.uint8)
    pair = RectifiedPair(left, left, camera_for(30, 20))
    found = match_as_printed(pair, 5, signed=True)
    expected = np.zeros(left.shape, dtype=bool)
    expected[2:-2, 2:-2] = True
    assert np.array_equal(found.valid, expected)
    assert np.all(found.reason[~expected] == Reason.BORDER)


@pytest.mark.parametrize("level", [0, 255])
def test_an_image_without_texture_gives_disparity_zero(level: int) -> None:
    flat = np.full((12, 15), level, dtype=np.uint8)
    values = match(flat, flat, patch_px=3, signed=False)
    assert np.all(values[1:-1, 1:-1] == 0)


def test_a_patch_larger_than_the_image_is_refused() -> None:
    flat = np.zeros((4, 40), dtype=np.uint8)
    with pytest.raises(MatchingError, match="at most 4 px"):
        match(flat, flat, patch_px=5)


@settings(max_examples=40)
@given(
    data=st.data(),
    shape=st.tuples(st.integers(3, 8), st.integers(3, 14)),
    patch_px=st.sampled_from([1, 3]),
    signed=st.booleans(),
)
def test_it_equals_the_sums_written_out(
    data: st.DataObject, shape: tuple[int, int], patch_px: int, signed: bool
) -> None:
    left = data.draw(hnp.arrays(np.uint8, shape))
    right = data.draw(hnp.arrays(np.uint8, shape))
    found = match(left, right, patch_px=patch_px, signed=signed, ndisp=6)
    assert np.array_equal(found, written_out(left, right, patch_px, signed), equal_nan=True)


def written_out(left: UInt8, right: UInt8, patch_px: int, signed: bool) -> Float32:
    """The same in loops: float32 (H, W), NaN where no patch fits."""
    r = patch_px // 2
    height, width = left.shape
    values = np.full(left.shape, np.nan, dtype=np.float32)
    for y in range(r, height - r):
        for x in range(r, width - r):
            patch = left[y - r : y + r + 1, x - r : x + r + 1].astype(int)
            sums = []
            for d in range(min(6, x - r + 1)):
                there = right[y - r : y + r + 1, x - d - r : x - d + r + 1].astype(int)
                sums.append((patch - there if signed else np.abs(patch - there)).sum())
            values[y, x] = int(np.argmin(sums))
    return values
