"""The SAD matcher on images whose disparity is known exactly."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from recon.core.errors import MatchingError, SettingsError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, Float64
from recon.stereo.kernels.refine import EQUIANGULAR, NO_FIT, PARABOLA
from recon.stereo.match import sad, search
from recon.stereo.match.sad import SadMatcher, SadSettings
from recon.stereo.match.search import usual_ndisp
from tests.stereo.match.images import (
    HEIGHT,
    WIDTH,
    inner,
    make_pair,
    noise,
    warped_pair,
)

PLAIN = SadSettings(ndisp=32)


def test_whole_shift_is_found_exactly() -> None:
    scene = noise(width=WIDTH + 9)
    found = SadMatcher(PLAIN).match(make_pair(scene[:, :WIDTH], scene[:, 9:]))
    values = inner(found.values)
    assert np.isfinite(values).all()
    # The fit moves a perfect match by up to half the difference of two neighbouring costs.
    assert np.median(np.abs(values - 9)) < 0.05
    assert (np.rint(values) == 9).all()


@pytest.fixture
def no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disparities stay whole."""
    monkeypatch.setattr(search, "FIT", NO_FIT)


@pytest.mark.usefixtures("no_fit")
def test_whole_shift_without_fit_has_no_error_at_all() -> None:
    scene = noise(width=WIDTH + 9)
    values = SadMatcher(PLAIN).match(make_pair(scene[:, :WIDTH], scene[:, 9:])).values
    assert (inner(values) == 9).all()


@pytest.mark.usefixtures("no_fit")
@pytest.mark.parametrize("shift", [-6, -1, 0])
def test_negative_disparities_are_found(shift: int) -> None:
    scene = noise(width=WIDTH + 16)
    left, right = scene[:, 8 : 8 + WIDTH], scene[:, 8 + shift : 8 + shift + WIDTH]
    settings = SadSettings(min_disparity_px=-10, ndisp=20)
    values = SadMatcher(settings).match(make_pair(left, right)).values
    assert (inner(values, margin=20) == shift).all()


@pytest.mark.parametrize("shift", [5.25, 7.5, 10.8])
@pytest.mark.parametrize("fit", [EQUIANGULAR, PARABOLA])
def test_fraction_of_a_pixel_is_recovered(
    shift: float, fit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search, "FIT", fit)
    pair = warped_pair(np.full((HEIGHT, WIDTH), shift))
    values = inner(SadMatcher(PLAIN).match(pair).values)
    # A tenth of a pixel is what the fits reach on clean images; 0.25 is the mean without a fit.
    assert np.nanmedian(np.abs(values - shift)) < 0.1
    assert np.isfinite(values).mean() > 0.95


def ground(slant: float) -> tuple[RectifiedPair, Float64]:
    """A plane whose disparity grows by ``slant`` per row, and its disparity."""
    row = np.arange(HEIGHT, dtype=np.float64)[:, None]
    truth = np.broadcast_to(4 + slant * row, (HEIGHT, WIDTH)).copy()
    return warped_pair(truth), truth


def test_slanted_plane_is_followed() -> None:
    pair, truth = ground(0.2)
    found = SadMatcher(PLAIN).match(pair)
    # The disparity is constant along a row, so it is the same on the grid of both views.
    error = inner(np.abs(found.values - truth))
    assert np.nanmedian(error) < 0.15
    assert np.isfinite(error).mean() > 0.9


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


def square_before_wall() -> tuple[RectifiedPair, np.ndarray]:
    """A square (disparity 20) before a wall (disparity 4), and the mask of its half shadow."""
    wall, square = noise(80, 160, seed=3), noise(40, 50, seed=4)
    left, right = wall[:, :144].copy(), wall[:, 4:148].copy()
    left[20:60, 70:120] = square
    right[20:60, 50:100] = square
    # The square hides wall columns 50 to 99 of the right view, 54 to 103 of the left one.
    hidden = np.zeros(left.shape, bool)
    hidden[20:60, 54:70] = True
    return make_pair(left, right), hidden


def test_half_occluded_wall_is_occluded_and_not_given_a_value() -> None:
    pair, hidden = square_before_wall()
    found = SadMatcher(SadSettings(ndisp=32, min_texture=0)).match(pair)
    # Windows that reach over the edge of the square may take its side: half a window aside.
    core = np.zeros_like(hidden)
    core[24:56, 54:62] = True
    # What is behind the square does not reach the end of what is searched there, or it is hidden.
    hidden_there = [Reason.OCCLUDED, Reason.OUT_OF_RANGE]
    assert np.isin(found.reason[core], hidden_there).mean() > 0.8
    assert found.valid[core].mean() < 0.1
    assert np.nanmedian(found.values[25:55, 80:110]) == pytest.approx(20, abs=0.1)
    assert np.nanmedian(found.values[25:55, 10:45]) == pytest.approx(4, abs=0.1)


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


def test_pixels_without_an_image_are_border() -> None:
    scene = noise()
    valid = np.ones(scene.shape, bool)
    valid[:, 50:60] = False
    found = SadMatcher(PLAIN).match(make_pair(scene, scene, valid))
    assert (found.reason[:, 50:60] == Reason.BORDER).all()


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_number_of_threads_does_not_change_the_result(threads: int) -> None:
    pair, _ = square_before_wall()
    one, many = SadMatcher(PLAIN, 1).match(pair), SadMatcher(PLAIN, threads).match(pair)
    for name in ("values", "confidence", "sigma_px", "reason"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30, 1), (3, 5)])
def test_tiny_images_give_a_map_of_their_size(shape: tuple[int, int]) -> None:
    grey = np.zeros(shape, np.uint8)
    found = SadMatcher(SadSettings(ndisp=40)).match(make_pair(grey, grey))
    assert found.values.shape == shape
    assert not found.valid.any()


@pytest.mark.usefixtures("no_fit")
def test_range_wider_than_the_image_is_searched_where_it_can_be() -> None:
    scene = noise(width=WIDTH + 9)
    settings = SadSettings(min_disparity_px=-300, ndisp=600)
    found = SadMatcher(settings).match(make_pair(scene[:, :WIDTH], scene[:, 9:]))
    assert (inner(found.values) == 9).mean() > 0.99


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


def test_range_outside_the_image_is_an_error() -> None:
    grey = noise()
    matcher = SadMatcher(SadSettings(min_disparity_px=200))
    with pytest.raises(MatchingError, match="200 to 215 px"):
        matcher.match(make_pair(grey, grey))


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
