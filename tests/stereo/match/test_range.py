"""The automatic range holds what is there, on planes of known disparity and on real pairs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.core.values import Disparity, RectifiedPair
from recon.io.middlebury import read_middlebury_scene, stand_in_camera
from recon.stereo.match.range import AutoRangeMatcher, estimate_ndisp
from recon.stereo.match.registry import MATCHERS, MatchingSettings, make_matcher, settings_of
from recon.stereo.match.sad import SadSettings
from recon.stereo.match.search import usual_ndisp
from recon.stereo.rectify.grey import to_grey

HEIGHT, WIDTH = 160, 480


def plane(disparity_px: int, width: int = WIDTH) -> RectifiedPair:
    rng = np.random.default_rng(disparity_px)
    scene = rng.integers(0, 256, (HEIGHT, width + disparity_px), dtype=np.uint8)
    # Wide enough a texture to be left when the image is made smaller.
    scene = cv2.normalize(cv2.GaussianBlur(scene, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    camera = stand_in_camera(width, HEIGHT)
    return RectifiedPair(scene[:, :width], scene[:, disparity_px:], camera)


@pytest.mark.parametrize("disparity_px", [3, 40, 75, 120, 170])
def test_range_of_a_plane_holds_it_without_waste(disparity_px: int) -> None:
    ndisp = estimate_ndisp(plane(disparity_px))
    assert disparity_px < ndisp - 1
    # A tenth, a small pixel and a step of 16 above it, or the usual range.
    assert ndisp <= max(usual_ndisp(WIDTH), 1.1 * disparity_px + 24)
    assert ndisp % 16 == 0


def test_negative_minimum_widens_the_range() -> None:
    assert estimate_ndisp(plane(75), minimum_px=-32) == estimate_ndisp(plane(75)) + 32


@pytest.mark.parametrize("shape", [(1, 1), (1, 900), (900, 1), (3, 5), (90, 480)])
def test_images_without_matches_get_the_usual_range(shape: tuple[int, int]) -> None:
    grey = np.full(shape, 77, np.uint8)
    pair = RectifiedPair(grey, grey, stand_in_camera(shape[1], shape[0]))
    assert estimate_ndisp(pair) == usual_ndisp(shape[1])


def test_range_depends_on_the_pair_alone() -> None:
    matcher = make_matcher("sad", threads=1)
    first = matcher.match(plane(75))
    matcher.match(plane(170))
    np.testing.assert_array_equal(matcher.match(plane(75)).values, first.values)


def near_share(found: Disparity, disparity_px: int) -> float:
    return float((np.abs(found.values[:, disparity_px + 8 :] - disparity_px) < 0.5).mean())


@pytest.mark.parametrize("name", ["sad", "sgm", "opencv-bm", "opencv-sgbm"])
def test_near_plane_is_found_only_with_the_automatic_range(name: str) -> None:
    padded = {"opencv": {"pad": True}}
    settings, pair = MatchingSettings.parse(padded), plane(100)
    auto = make_matcher(name, settings, 1)
    usual = MATCHERS[name](settings_of(name, settings), 1)
    assert near_share(auto.match(pair), 100) > 0.9
    assert near_share(usual.match(pair), 100) < 0.1


def test_range_of_settings_or_calibration_is_kept() -> None:
    assert not isinstance(
        make_matcher("sad", MatchingSettings(sad=SadSettings(ndisp=16))), AutoRangeMatcher
    )
    pair = plane(100)
    known = replace(pair, camera=replace(pair.camera, ndisp=32))
    assert near_share(make_matcher("sad").match(known), 100) < 0.1


@pytest.mark.real
def test_range_holds_the_truth_of_real_pairs(recon_data: Path) -> None:
    folder = recon_data / "middlebury"
    scenes = [
        f for part in ("MiddEval3/trainingQ", "2005", "2006") for f in (folder / part).iterdir()
    ]
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
