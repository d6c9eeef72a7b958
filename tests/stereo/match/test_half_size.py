"""Rough disparities are those of the full size, nearly as dense, and less precise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.stereo.match.range import HalfSizeMatcher
from recon.stereo.match.sad import SadSettings
from tests.stereo.match.images import HEIGHT, WIDTH, inner, warped_pair

SEARCH = SadSettings(ndisp=32)


@pytest.mark.parametrize("shift", [5.25, 7.5, 10.8])
@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (HEIGHT + 1, WIDTH + 1)])
def test_disparities_are_right_to_a_fraction_of_a_pixel(
    shift: float, size: tuple[int, int]
) -> None:
    found = HalfSizeMatcher(SEARCH, threads=1).match(warped_pair(np.full(size, shift)))

    values = inner(found.values)
    assert found.values.shape == size
    assert np.nanmedian(np.abs(values - shift)) < 0.3
    assert np.isfinite(values).mean() > 0.9
    assert np.nanmin(found.sigma_px) >= 0.2  # twice that of half size


def test_the_range_is_that_of_the_full_size() -> None:
    pair = warped_pair(np.full((HEIGHT, WIDTH), 20.0))
    negative = SadSettings(min_disparity_px=-8, ndisp=16)
    narrow = SadSettings(ndisp=12)

    assert np.isfinite(inner(HalfSizeMatcher(SEARCH).match(pair).values)).mean() > 0.8
    for settings in (narrow, negative):
        values = HalfSizeMatcher(settings).match(pair).values
        assert not (np.abs(inner(values) - 20.0) < 2).any()


def test_the_calibration_may_know_the_range() -> None:
    pair = warped_pair(np.full((HEIGHT, WIDTH), 20.0))
    known = replace(pair, camera=replace(pair.camera, ndisp=32))

    values = inner(HalfSizeMatcher(SadSettings()).match(known).values)

    assert np.nanmedian(np.abs(values - 20.0)) < 0.3


def test_pixels_without_a_source_have_no_disparity() -> None:
    valid = np.ones((HEIGHT, WIDTH), np.bool_)
    valid[:20] = False
    pair = replace(warped_pair(np.full((HEIGHT, WIDTH), 8.0)), valid=valid)

    found = HalfSizeMatcher(SEARCH).match(pair)

    assert not found.valid[:20].any()
    assert found.valid[20:].any()
