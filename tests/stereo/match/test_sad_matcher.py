"""The SAD matcher on images whose disparity is known exactly, beyond `test_our_matchers.py`."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, Float64
from recon.stereo.match import sad
from recon.stereo.match.sad import SadMatcher, SadSettings
from recon.stereo.match.search import usual_ndisp
from tests.stereo.match.images import HEIGHT, WIDTH, inner, make_pair, noise, warped_pair

PLAIN = SadSettings(ndisp=32)


def ground(slant: float) -> tuple[RectifiedPair, Float64]:
    """A plane whose disparity grows by ``slant`` per row, and its disparity."""
    row = np.arange(HEIGHT, dtype=np.float64)[:, None]
    truth = np.broadcast_to(4 + slant * row, (HEIGHT, WIDTH)).copy()
    return warped_pair(truth), truth


def test_slanted_window_sees_the_ground_more_completely_and_better() -> None:
    pair, truth = ground(1 / 3)
    errors = []
    for slant in (0, 1 / 3):
        with patch.object(sad, "WINDOW_SLANT", slant):
            found = SadMatcher(SadSettings(ndisp=32)).match(pair)
        errors.append(inner(np.abs(found.values - truth)))
    density = [np.isfinite(error).mean() for error in errors]
    assert density[1] >= density[0]
    # Half, if the window were slanted by every row; its halves shift by whole disparities.
    assert np.nanmedian(errors[1]) < 0.6 * np.nanmedian(errors[0])


def test_left_border_columns_are_searched_as_far_as_the_right_image_reaches() -> None:
    scene = noise(width=WIDTH + 3)
    found = SadMatcher(SadSettings(ndisp=64)).match(make_pair(scene[:, :WIDTH], scene[:, 3:]))
    # Far left of column 63, where a matcher that wants all 64 disparities gives nothing.
    assert np.isfinite(found.values[:, 6:63]).mean() > 0.97
    assert np.nanmax(np.abs(found.values[:, 6:63] - 3)) < 0.5


def test_flat_image_has_low_texture_everywhere() -> None:
    grey = np.full((20, 40), 90, np.uint8)
    found = SadMatcher(PLAIN).match(make_pair(grey, grey))
    assert (found.reason == Reason.LOW_TEXTURE).all()
    assert not found.confidence.any()


def test_repeated_pattern_is_ambiguous() -> None:
    stripes = np.tile(np.repeat(np.array([40, 200], np.uint8), 4), (40, 20))
    found = SadMatcher(PLAIN).match(make_pair(stripes, stripes))
    assert not inner(found.valid).any()


def test_shift_beyond_the_range_is_mostly_refused_and_never_trusted() -> None:
    scene = noise(width=WIDTH + 20)
    pair = make_pair(scene[:, :WIDTH], scene[:, 20:])
    settings = SadSettings(ndisp=12, uniqueness_percent=15)
    wrong, right = (SadMatcher(s).match(pair) for s in (settings, PLAIN))
    # Chance alone lets windows of noise resemble each other in both views.
    assert inner(wrong.valid).mean() < 0.2
    assert np.max(inner(wrong.confidence)) < np.median(inner(right.confidence))


def test_minimum_at_an_end_of_the_range_is_out_of_range() -> None:
    scene = noise(width=WIDTH + 7)
    found = SadMatcher(SadSettings(ndisp=8)).match(make_pair(scene[:, :WIDTH], scene[:, 7:]))
    assert (inner(found.reason) == Reason.OUT_OF_RANGE).mean() > 0.99


def normalised_errors(found: Disparity, truth: float) -> Float32:
    """Errors of the inner part in units of sigma, gross errors left out."""
    error = inner(found.values - np.float32(truth))
    kept = np.abs(error) < 1
    return np.asarray(np.abs(error / inner(found.sigma_px))[kept])


@pytest.mark.parametrize("grey_noise", [2.0, 6.0])
def test_sigma_covers_the_errors_of_noisy_images(grey_noise: float) -> None:
    clean = warped_pair(np.full((HEIGHT, WIDTH), 7.3))
    rng = np.random.default_rng(5)
    left, right = (
        np.clip(image + rng.normal(0, grey_noise, image.shape), 0, 255).astype(np.uint8)
        for image in (clean.left, clean.right)
    )
    errors = normalised_errors(SadMatcher(PLAIN).match(make_pair(left, right)), 7.3)
    # Of a normal distribution 95 % lie within two sigma; a sigma of no use would give 100 %
    # within a fifth of one.
    assert (errors < 2).mean() > 0.9
    assert (errors < 0.2).mean() < 0.8


@pytest.mark.parametrize(("width", "ndisp"), [(1, 16), (160, 16), (640, 64), (1242, 128)])
def test_usual_range_is_a_tenth_of_the_width(width: int, ndisp: int) -> None:
    assert usual_ndisp(width) == ndisp


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"window_px": 10}, "odd"),
        ({"window_px": 57}, "less than or equal to 55"),
        ({"window": 9}, "unknown setting"),
        ({"uniqueness_percent": -1}, "uniqueness_percent"),
    ],
)
def test_settings_that_cannot_work_are_refused(values: dict[str, int], complaint: str) -> None:
    with pytest.raises(SettingsError, match=complaint):
        SadSettings.parse(values)


def test_costs_of_the_widest_window_fit_the_kernel() -> None:
    widest = 55
    with pytest.raises(SettingsError):
        SadSettings.parse({"window_px": widest + 2})
    assert widest * (widest + 1) * sad._COST_CAP < 65535
