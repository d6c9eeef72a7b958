"""What our matchers promise, on images whose disparity is known exactly."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from recon.core.errors import MatchingError, SettingsError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float64
from recon.stereo.kernels.refine import Rules
from recon.stereo.match import sad, search
from recon.stereo.match.registry import MatchingSettings, make_matcher
from recon.stereo.match.sad import SadMatcher, SadSettings
from recon.stereo.match.sgm import SgmMatcher, SgmSettings
from tests.stereo.match.images import (
    HEIGHT,
    WIDTH,
    inner,
    make_pair,
    noise,
    square_before_wall,
    warped_pair,
)

Match = Callable[..., Disparity]
SAD, SGM = SadSettings(ndisp=32), SgmSettings(ndisp=32)


@pytest.fixture(params=["sad", "sgm"])
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def match(name: str) -> Match:
    """Matches a pair, by default in 32 disparities."""

    def matched(pair: RectifiedPair, *, threads: int | None = None, **settings: int) -> Disparity:
        chosen = MatchingSettings.parse({name: {"ndisp": 32, **settings}})
        return make_matcher(name, chosen, threads).match(pair)

    return matched


def shifted_noise(shift: int) -> RectifiedPair:
    """Noise, ``shift`` pixels farther left in the right image."""
    scene = noise(width=WIDTH + 32)
    return make_pair(scene[:, 8 : 8 + WIDTH], scene[:, 8 + shift : 8 + shift + WIDTH])


def test_whole_shift_is_found_exactly(match: Match) -> None:
    values = inner(match(shifted_noise(8)).values)
    assert (np.rint(values) == 8).all()
    # The fit moves a perfect match by up to half the difference of two neighbouring costs.
    assert np.median(np.abs(values - 8)) < 0.05


@pytest.mark.parametrize("shift", [-6, -1, 0, 8])
def test_whole_shift_of_either_sign_has_no_error_without_a_fit(match: Match, shift: int) -> None:
    with patch.object(search, "Rules", partial(Rules, fit=False)):
        values = match(shifted_noise(shift), min_disparity_px=-10, ndisp=20).values
    assert (inner(values, margin=20) == shift).all()


@pytest.mark.parametrize("shift", [5.25, 7.5, 10.8])
def test_fraction_of_a_pixel_is_recovered(name: str, match: Match, shift: float) -> None:
    values = inner(match(warped_pair(np.full((HEIGHT, WIDTH), shift))).values)
    # 0.25 is what it is off by without a fit. A tenth is what the fit reaches on clean images; the
    # caps on single costs of the semi-global matcher pull towards whole pixels.
    assert np.nanmedian(np.abs(values - shift)) < {"sad": 0.1, "sgm": 0.2}[name]
    assert np.isfinite(values).mean() > 0.95


def ground(slant: float) -> tuple[RectifiedPair, Float64]:
    """A plane whose disparity grows by ``slant`` per row, the same in both views."""
    row = np.arange(HEIGHT, dtype=np.float64)[:, None]
    truth = np.broadcast_to(4 + slant * row, (HEIGHT, WIDTH)).copy()
    return warped_pair(truth), truth


def test_slanted_plane_is_followed(match: Match) -> None:
    pair, truth = ground(0.2)
    error = inner(np.abs(match(pair).values - truth))
    assert np.nanmedian(error) < 0.15
    assert np.isfinite(error).mean() > 0.9


def test_half_occluded_wall_is_occluded_and_not_given_a_value(match: Match) -> None:
    pair, hidden = square_before_wall()
    found = match(pair)
    # Windows that reach over the edge of the square may take its side: half a window aside.
    core = np.zeros_like(hidden)
    core[24:56, 56:62] = True
    # What is behind the square does not reach the end of what is searched there, or it is hidden.
    hidden_there = [Reason.OCCLUDED, Reason.OUT_OF_RANGE]
    assert np.isin(found.reason[core], hidden_there).mean() > 0.5
    assert found.valid[core].mean() < 0.2
    assert np.nanmedian(found.values[25:55, 80:110]) == pytest.approx(20, abs=0.1)
    assert np.nanmedian(found.values[25:55, 10:45]) == pytest.approx(4, abs=0.1)


def test_pixels_without_an_image_are_border(match: Match) -> None:
    scene = noise()
    valid = np.ones(scene.shape, bool)
    valid[:, 50:60] = False
    assert (match(make_pair(scene, scene, valid)).reason[:, 50:60] == Reason.BORDER).all()


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_number_of_threads_does_not_change_the_result(match: Match, threads: int) -> None:
    scene = noise(height=450, width=89)  # several strips of rows
    pair = make_pair(scene[:, :80], scene[:, 9:])
    one, many = match(pair, threads=1), match(pair, threads=threads)
    for field in fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(many, field.name))


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 3), (40, 60)])
@pytest.mark.parametrize("level", [0, 7, 255])
def test_images_without_content_have_no_disparity(
    name: str, match: Match, shape: tuple[int, int], level: int
) -> None:
    grey = np.full(shape, level, np.uint8)
    found = match(make_pair(grey, grey))
    assert found.values.shape == shape
    assert np.isnan(found.values).all()
    assert (found.confidence == 0).all()
    assert name == "sgm" or (found.reason == Reason.LOW_TEXTURE).all()


def test_range_far_wider_than_the_image_is_searched_and_one_outside_is_an_error(
    match: Match,
) -> None:
    pair = shifted_noise(8)
    found = match(pair, min_disparity_px=-300, ndisp=600)
    assert (np.abs(inner(found.values) - 8) < 0.5).mean() > 0.99
    for first, words in ((WIDTH, "120 to 151 px"), (-WIDTH - 31, "-151 to -120 px")):
        with pytest.raises(MatchingError, match=rf"no disparity of the range.*{words}"):
            match(pair, min_disparity_px=first)
        match(pair, min_disparity_px=first - int(np.sign(first)))


def test_slanted_window_sees_the_ground_more_completely_and_better() -> None:
    pair, truth = ground(1 / 3)
    errors = []
    for slant in (0, 1 / 3):
        with patch.object(sad, "WINDOW_SLANT", slant):
            errors.append(inner(np.abs(SadMatcher(SAD).match(pair).values - truth)))
    density = [np.isfinite(error).mean() for error in errors]
    assert density[1] >= density[0]
    # Half, if the window were slanted by every row; its halves shift by whole disparities.
    assert np.nanmedian(errors[1]) < 0.6 * np.nanmedian(errors[0])


def test_left_border_columns_are_searched_as_far_as_the_right_image_reaches() -> None:
    found = SadMatcher(SadSettings(ndisp=64)).match(shifted_noise(3))
    # Far left of column 63, where a matcher that wants all 64 disparities gives nothing.
    assert np.isfinite(found.values[:, 6:63]).mean() > 0.97
    assert np.nanmax(np.abs(found.values[:, 6:63] - 3)) < 0.5


def test_repeated_pattern_is_ambiguous() -> None:
    stripes = np.tile(np.repeat(np.array([40, 200], np.uint8), 4), (40, 20))
    found = SadMatcher(SAD).match(make_pair(stripes, stripes))
    assert not inner(found.valid).any()


def test_shift_beyond_the_range_is_mostly_refused_and_never_trusted() -> None:
    settings = SadSettings(ndisp=12, uniqueness_percent=15)
    wrong, right = (SadMatcher(s).match(shifted_noise(20)) for s in (settings, SAD))
    # Chance alone lets windows of noise resemble each other in both views.
    assert inner(wrong.valid).mean() < 0.2
    assert np.max(inner(wrong.confidence)) < np.median(inner(right.confidence))


def test_minimum_at_an_end_of_the_range_is_out_of_range() -> None:
    found = SadMatcher(SadSettings(ndisp=8)).match(shifted_noise(7))
    assert (inner(found.reason) == Reason.OUT_OF_RANGE).mean() > 0.99


@pytest.mark.parametrize("grey_noise", [2.0, 6.0])
def test_sigma_covers_the_errors_of_noisy_images(grey_noise: float) -> None:
    clean, rng = warped_pair(np.full((HEIGHT, WIDTH), 7.3)), np.random.default_rng(5)
    left, right = (
        np.clip(image + rng.normal(0, grey_noise, image.shape), 0, 255).astype(np.uint8)
        for image in (clean.left, clean.right)
    )
    found = SadMatcher(SAD).match(make_pair(left, right))
    error = inner(found.values - np.float32(7.3))
    errors = np.abs(error / inner(found.sigma_px))[np.abs(error) < 1]
    # Of a normal distribution 95 % lie within two sigma; a sigma of no use would give 100 %
    # within a fifth of one.
    assert (errors < 2).mean() > 0.9
    assert (errors < 0.2).mean() < 0.8


def test_costs_of_the_widest_window_fit_the_kernel() -> None:
    widest = 55
    with pytest.raises(SettingsError):
        SadSettings.parse({"window_px": widest + 2})
    assert widest * (widest + 1) * sad._COST_CAP < 65535


@pytest.mark.parametrize("seed", [0, 1])
def test_slanted_ground_of_weak_texture_is_dense_and_right(seed: int) -> None:
    """Along a row it has one disparity; on every other path each third step is paid for."""
    height, width, rng = 120, 260, np.random.default_rng(seed)
    truth = np.broadcast_to(6 + np.arange(height)[:, None] / 3, (height, width))
    texture = cv2.GaussianBlur(rng.normal(size=(height, width + 64)), (0, 0), 1.5)
    texture *= 3 / texture.std()
    y, x = np.mgrid[:height, :width].astype(np.float32)
    right = cv2.remap(texture, x + truth.astype(np.float32), y, cv2.INTER_CUBIC)
    left, right = (
        np.rint(120 + view + rng.normal(0, 2, view.shape)).astype(np.uint8)
        for view in (texture[:, :width], right)
    )
    found = SgmMatcher(SgmSettings(ndisp=64)).match(make_pair(left, right))
    error = inner(np.abs(found.values - truth), left=70)
    known = np.isfinite(error)
    # Measured: 0.99 and 0.98 known, 0.02 and 0.04 of it wrong; 0.6 and 0.3 to 0.4 without paths
    # along the row.
    assert known.mean() > 0.95
    assert (error[known] > 1).mean() < 0.08


def test_what_is_flat_is_filled_in_from_what_is_not() -> None:
    scene = noise(width=WIDTH + 9)
    scene[24:36, 60:90] = 128
    found = SgmMatcher(SGM).match(make_pair(scene[:, :WIDTH], scene[:, 9:]))
    assert (np.abs(found.values[24:36, 60:81] - 9) < 1).mean() > 0.95


def test_brightness_and_contrast_of_one_camera_matter_little() -> None:
    pair = shifted_noise(9)
    dimmed = (pair.right * 0.7 + 20).astype(np.uint8)
    values = SgmMatcher(SGM).match(make_pair(pair.left, dimmed)).values
    assert (np.abs(inner(values) - 9) < 0.5).mean() > 0.97


def test_penalties_that_do_not_fit_or_have_their_old_names_are_refused() -> None:
    assert SgmSettings(p1=50.0).p2 == 50.0
    for wrong, words in (({"p1": 70.0}, "exceed"), ({"small_penalty": 1.0}, "now called p1")):
        with pytest.raises(SettingsError, match=words):
            SgmSettings.parse(wrong)


@pytest.mark.parametrize("settings", [SadSettings, SgmSettings])
def test_even_windows_are_refused(settings: type[SadSettings | SgmSettings]) -> None:
    with pytest.raises(SettingsError, match="odd"):
        settings.parse({"window_px": 10})


@pytest.mark.slow
def test_memory_of_a_large_pair_is_bounded() -> None:
    code = """
import resource
import numpy as np
from recon.io.middlebury import stand_in_camera
from recon.stereo.match.sgm import SgmMatcher, SgmSettings
from recon.core.values import RectifiedPair
grey = np.random.default_rng(0).integers(0, 256, (2000, 3000), dtype=np.uint8)
pair = RectifiedPair(grey, np.roll(grey, -40, 1), stand_in_camera(3000, 2000))
SgmMatcher(SgmSettings(ndisp=300), threads=8).match(pair)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 100e3 < int(done.stdout) < 2.5e6  # kilobytes
