"""Estimated ranges hold what is there; rough disparities are right, and less precise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.core.values import Disparity, RectifiedPair
from recon.io.middlebury import read_middlebury_scene, stand_in_camera
from recon.stereo.match.registry import (
    MATCHERS,
    MatchingSettings,
    make_matcher,
    searched,
    settings_of,
)
from recon.stereo.match.sad import AutoRangeMatcher, HalfSizeMatcher, SadSettings, estimate_ndisp
from recon.stereo.match.search import usual_ndisp
from recon.stereo.match.sgm import SgmSettings
from recon.stereo.rectify.rectifier import to_grey
from tests.stereo.match.images import HEIGHT, WIDTH, inner, warped_pair


def plane(disparity_px: int) -> RectifiedPair:
    rng = np.random.default_rng(disparity_px)
    scene = rng.integers(0, 256, (160, 480 + disparity_px), dtype=np.uint8)
    # Wide enough a texture to be left when the image is made smaller.
    scene = cv2.normalize(cv2.GaussianBlur(scene, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    return RectifiedPair(scene[:, :480], scene[:, disparity_px:], stand_in_camera(480, 160))


def near_share(found: Disparity, disparity_px: int) -> float:
    return float((np.abs(found.values[:, disparity_px + 8 :] - disparity_px) < 0.5).mean())


@pytest.mark.parametrize("disparity_px", [3, 40, 75, 120, 170])
def test_range_of_a_plane_holds_it_without_waste(disparity_px: int) -> None:
    ndisp = estimate_ndisp(plane(disparity_px))
    assert disparity_px < ndisp - 1
    # A tenth, a small pixel and a step of 16 above it, or the usual range.
    assert ndisp <= max(usual_ndisp(480), 1.1 * disparity_px + 24)
    assert ndisp % 16 == 0


def test_negative_minimum_widens_the_range() -> None:
    assert estimate_ndisp(plane(75), minimum_px=-32) == estimate_ndisp(plane(75)) + 32


@pytest.mark.parametrize("shape", [(1, 1), (1, 900), (900, 1), (3, 5), (90, 480)])
def test_images_without_matches_get_the_usual_range(shape: tuple[int, int]) -> None:
    grey = np.full(shape, 77, np.uint8)
    pair = RectifiedPair(grey, grey, stand_in_camera(shape[1], shape[0]))
    assert estimate_ndisp(pair) == usual_ndisp(shape[1])


@pytest.mark.parametrize(("width", "ndisp"), [(1, 16), (160, 16), (640, 64), (1242, 128)])
def test_usual_range_is_a_tenth_of_the_width(width: int, ndisp: int) -> None:
    assert usual_ndisp(width) == ndisp


def test_range_depends_on_the_pair_alone() -> None:
    matcher = make_matcher("sad", threads=1)
    first = matcher.match(plane(75))
    matcher.match(plane(170))
    np.testing.assert_array_equal(matcher.match(plane(75)).values, first.values)


@pytest.mark.parametrize("name", ["sad", "sgm", "opencv-bm", "opencv-sgbm"])
def test_near_plane_is_found_only_with_the_automatic_range(name: str) -> None:
    settings, pair = MatchingSettings.parse({"opencv": {"pad": True}}), plane(100)
    usual = MATCHERS[name](settings_of(name, settings), 1)
    assert near_share(make_matcher(name, settings, 1).match(pair), 100) > 0.9
    assert near_share(usual.match(pair), 100) < 0.1


def test_range_of_settings_or_calibration_is_kept() -> None:
    narrow = MatchingSettings(sad=SadSettings(ndisp=16))
    assert not isinstance(make_matcher("sad", narrow), AutoRangeMatcher)
    pair = plane(100)
    known = replace(pair, camera=replace(pair.camera, ndisp=32))
    assert near_share(make_matcher("sad").match(known), 100) < 0.1
    assert searched(narrow) is narrow.sad
    assert searched(MatchingSettings(matcher="sgm")) == SgmSettings()
    assert searched(MatchingSettings(matcher="onnx")) == SadSettings()


@pytest.mark.real
def test_range_holds_the_truth_of_real_pairs(recon_data: Path) -> None:
    folder = recon_data / "middlebury"
    parts = ("MiddEval3/trainingQ", "2005", "2006")
    scenes = [scene for part in parts for scene in (folder / part).iterdir()]
    assert scenes
    for scene in map(read_middlebury_scene, scenes):
        left, right = to_grey(scene.pair.left), to_grey(scene.pair.right)
        camera = stand_in_camera(left.shape[1], left.shape[0])
        ndisp = estimate_ndisp(RectifiedPair(left, right, camera))
        assert scene.truth is not None
        truth = scene.truth.values[np.isfinite(scene.truth.values)]
        assert (truth < ndisp - 1).mean() > 0.99, scene.name
        # Wider than needed by a third and two steps, or the usual range.
        assert ndisp <= max(usual_ndisp(left.shape[1]), 4 / 3 * truth.max() + 32), scene.name


SEARCH = SadSettings(ndisp=32)


@pytest.mark.parametrize("shift", [5.25, 7.5, 10.8])
@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (HEIGHT + 1, WIDTH + 1)])
def test_rough_disparities_are_right_to_a_fraction_of_a_pixel(
    shift: float, size: tuple[int, int]
) -> None:
    found = HalfSizeMatcher(SEARCH, threads=1).match(warped_pair(np.full(size, shift)))
    values = inner(found.values)
    assert found.values.shape == size
    assert np.nanmedian(np.abs(values - shift)) < 0.3
    assert np.isfinite(values).mean() > 0.9
    assert np.nanmin(found.sigma_px) >= 0.2  # twice that of half size


def test_the_rough_range_is_that_of_the_full_size_or_of_the_calibration() -> None:
    pair = warped_pair(np.full((HEIGHT, WIDTH), 20.0))
    known = replace(pair, camera=replace(pair.camera, ndisp=32))
    for settings, given in ((SEARCH, pair), (SadSettings(), known)):
        values = inner(HalfSizeMatcher(settings).match(given).values)
        assert np.isfinite(values).mean() > 0.8
        assert np.nanmedian(np.abs(values - 20.0)) < 0.3
    for settings in (SadSettings(ndisp=12), SadSettings(min_disparity_px=-8, ndisp=16)):
        values = inner(HalfSizeMatcher(settings).match(pair).values)
        assert not (np.abs(values - 20.0) < 2).any()


def test_pixels_without_a_source_have_no_rough_disparity() -> None:
    valid = np.ones((HEIGHT, WIDTH), np.bool_)
    valid[:20] = False
    pair = replace(warped_pair(np.full((HEIGHT, WIDTH), 8.0)), valid=valid)
    found = HalfSizeMatcher(SEARCH).match(pair)
    assert not found.valid[:20].any()
    assert found.valid[20:].any()
