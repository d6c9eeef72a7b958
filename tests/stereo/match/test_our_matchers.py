"""What both of our matchers promise, on images whose disparity is known exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial

import numpy as np
import pytest

from recon.core.errors import MatchingError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.stereo.kernels.refine import Rules
from recon.stereo.match import search
from recon.stereo.match.registry import MatchingSettings, make_matcher
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


@pytest.fixture
def no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disparities stay whole."""
    monkeypatch.setattr(search, "Rules", partial(Rules, fit=False))


def shifted_noise(shift: int) -> RectifiedPair:
    """Noise, ``shift`` pixels farther left in the right image."""
    scene = noise(width=WIDTH + 16)
    return make_pair(scene[:, 8 : 8 + WIDTH], scene[:, 8 + shift : 8 + shift + WIDTH])


def test_whole_shift_is_found_exactly(match: Match) -> None:
    values = inner(match(shifted_noise(8)).values)
    assert (np.rint(values) == 8).all()
    # The fit moves a perfect match by up to half the difference of two neighbouring costs.
    assert np.median(np.abs(values - 8)) < 0.05


@pytest.mark.usefixtures("no_fit")
@pytest.mark.parametrize("shift", [-6, -1, 0, 8])
def test_whole_shift_of_either_sign_has_no_error_without_a_fit(match: Match, shift: int) -> None:
    values = match(shifted_noise(shift), min_disparity_px=-10, ndisp=20).values
    assert (inner(values, margin=20) == shift).all()


@pytest.mark.parametrize("shift", [5.25, 7.5, 10.8])
def test_fraction_of_a_pixel_is_recovered(name: str, match: Match, shift: float) -> None:
    values = inner(match(warped_pair(np.full((HEIGHT, WIDTH), shift))).values)
    # 0.25 is what it is off by without a fit. A tenth is what the fit reaches on clean images; the
    # caps on single costs of the semi-global matcher pull towards whole pixels.
    assert np.nanmedian(np.abs(values - shift)) < {"sad": 0.1, "sgm": 0.2}[name]
    assert np.isfinite(values).mean() > 0.95


def test_slanted_plane_is_followed(match: Match) -> None:
    row = np.arange(HEIGHT, dtype=np.float64)[:, None]
    truth = np.broadcast_to(4 + 0.2 * row, (HEIGHT, WIDTH)).copy()
    # The disparity is constant along a row, so it is the same on the grid of both views.
    error = inner(np.abs(match(warped_pair(truth)).values - truth))
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
    match: Match, shape: tuple[int, int], level: int
) -> None:
    grey = np.full(shape, level, np.uint8)
    found = match(make_pair(grey, grey))
    assert found.values.shape == shape
    assert np.isnan(found.values).all()
    assert (found.confidence == 0).all()


def test_range_far_wider_than_the_image_is_searched(match: Match) -> None:
    found = match(shifted_noise(8), min_disparity_px=-300, ndisp=600)
    assert (np.abs(inner(found.values) - 8) < 0.5).mean() > 0.99


def test_range_outside_the_image_is_an_error(match: Match) -> None:
    grey = noise()
    with pytest.raises(MatchingError, match=r"no disparity of the range.*200 to 231 px"):
        match(make_pair(grey, grey), min_disparity_px=200)
