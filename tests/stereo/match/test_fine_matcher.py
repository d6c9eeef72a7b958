"""What the fine matcher promises: slants, plain areas, edges, reasons, pieces, memory."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from recon.commands.evaluate_middlebury import run_middlebury
from recon.core.errors import MatchingError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.kernels.convolution import UNIT
from recon.stereo.match import fill, fine, sgm
from recon.stereo.match.fine import Describer, fine_grey, load_network
from recon.stereo.match.registry import MatchingSettings, make_matcher
from recon.stereo.match.search import SearchSettings

HEIGHT, WIDTH = 120, 240
SETTINGS = SearchSettings(ndisp=48)


def rendered(truth: np.ndarray, texture: np.ndarray, noise: float = 1.0) -> RectifiedPair:
    """A surface whose disparity is given on the grid of the right view, with its texture."""
    y, x = np.mgrid[: truth.shape[0], : truth.shape[1]].astype(np.float32)
    left = texture[:, : truth.shape[1]]
    right = cv2.remap(texture, x + truth.astype(np.float32), y, cv2.INTER_CUBIC)
    rng = np.random.default_rng(3)
    views = [
        np.clip(np.rint(view + rng.normal(0, noise, view.shape)), 0, 255).astype(np.uint8)
        for view in (left, right)
    ]
    return RectifiedPair(*views, stand_in_camera(*truth.shape[::-1]))


def cloth(seed: int = 0, contrast: float = 25.0) -> np.ndarray:
    grey = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH + 64))
    grey = cv2.GaussianBlur(grey, (0, 0), 1.2)
    return (120 + contrast * grey / grey.std()).astype(np.float32)


def ground() -> np.ndarray:
    """Disparity of a plane that comes nearer with each row, the same in both views."""
    return np.broadcast_to(4 + np.arange(HEIGHT)[:, None] / 3, (HEIGHT, WIDTH))


def match(pair: RectifiedPair, threads: int | None = None, **settings: int) -> Disparity:
    asked = MatchingSettings.parse({"ndisp": 48, "fill": True, **settings})
    return make_matcher("fine", asked, threads).match(pair)


def test_slanted_ground_is_complete_and_right_to_a_fraction():
    truth = ground()
    found = match(rendered(truth, cloth(contrast=8)))
    error = np.abs(found.values - truth)[6:-6, 60:-6]
    assert np.isfinite(error).mean() > 0.97
    assert np.nanmedian(error) < 0.15
    assert (error > 1).mean() < 0.02


def test_what_is_plain_is_filled_as_planes_around_it_go_on_and_said():
    truth, texture = ground(), cloth()
    texture[40:80, 120:180] = 120
    pair = rendered(truth, texture, noise=1.5)
    found = match(pair)
    plain = np.s_[45:75, 125:140]  # seen without texture in both views
    error = np.abs(found.values - truth)
    filled = found.reason == Reason.FILLED
    # Half of it is reached by features of a wide surround, and measured; a fifth is filled.
    assert 0.15 < filled[plain].mean() < 0.3
    assert not filled[85:, 60:].any()
    assert (error[plain][filled[plain]] < 1).mean() > 0.95
    only = sgm.SgmMatcher(SETTINGS).match(pair)
    assert (np.abs(only.values - truth)[plain] < 1).mean() < 0.3
    seen = found.reason == Reason.VALID
    assert np.median(found.sigma_px[filled]) > 2 * np.median(found.sigma_px[seen])


def test_what_planes_lead_to_beyond_the_range_is_not_found():
    pair, values = rendered(ground(), cloth()), ground().astype(np.float32)
    values[:20, 100:] -= 30
    values[100:, 100:] += 30
    with patch.object(fine, "search_planes", lambda *_: values):
        found = match(pair, fill=False)
    beyond = (values < 0) | (values > 47)
    assert beyond.mean() > 0.05
    assert np.isnan(found.values[beyond]).all()
    assert np.isfinite(found.values[~beyond]).mean() > 0.5


def test_without_filling_all_that_has_a_value_was_measured():
    truth, texture = ground(), cloth()
    texture[40:80, 120:180] = 120
    pair = rendered(truth, texture, noise=1.5)
    found, both = match(pair, fill=False), match(pair)
    assert not found.inferred.any()
    np.testing.assert_array_equal(found.measured, both.measured)
    np.testing.assert_array_equal(found.values[found.valid], both.values[found.valid])


def test_a_wide_plain_wall_is_the_plane_of_its_rim():
    height, width = 200, 420
    y, x = np.mgrid[:height, :width]
    truth = 12 + x / 40 + y / 50
    texture = np.random.default_rng(5).normal(size=(height, width + 64))
    texture = 120 + 60 * cv2.GaussianBlur(texture, (0, 0), 1.2)
    texture[20:180, 60:400] = 120
    pair = rendered(truth, texture.astype(np.float32), noise=0.5)
    middle = np.s_[40:160, 110:350]
    right = np.abs(match(pair).values - truth)[middle] < 1
    with patch.object(fill, "_LEAST_PX", height * width):
        without = np.abs(match(pair).values - truth)[middle] < 1
    assert right.mean() > 0.95
    assert right.mean() > without.mean() + 0.1


def square_before_wall() -> tuple[RectifiedPair, np.ndarray]:
    """A square (disparity 20) before a wall (4), and the mask of its half shadow."""
    wall, square = cloth(1)[:, : WIDTH + 8], cloth(2)[:60, :70]
    left, right = wall[:, :WIDTH].copy(), wall[:, 4 : WIDTH + 4].copy()
    left[30:90, 110:180] = square
    right[30:90, 90:160] = square
    hidden = np.zeros(left.shape, bool)
    hidden[30:90, 94:110] = True
    views = [np.rint(view).astype(np.uint8) for view in (left, right)]
    return RectifiedPair(*views, stand_in_camera(WIDTH, HEIGHT)), hidden


def test_edges_are_where_the_image_has_them_and_the_half_shadow_is_occluded():
    pair, hidden = square_before_wall()
    found = match(pair)
    assert (found.reason[35:85, 96:108] == Reason.OCCLUDED).mean() > 0.7
    inside = found.values[33:87, 113:177]
    assert (np.abs(inside - 20) < 0.5).mean() > 0.99
    outside = np.ones(hidden.shape, bool)
    outside[27:93, 91:183] = outside[:, :40] = False
    assert (np.abs(found.values[outside] - 4) < 0.5).mean() > 0.99


def test_pixels_without_an_image_or_beyond_the_right_one_are_border():
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, 150:160] = False
    found = match(replace(rendered(np.full((HEIGHT, WIDTH), 20.0), cloth()), valid=valid))
    assert (found.reason[:, 150:160] == Reason.BORDER).all()
    assert (found.reason[:, :15] == Reason.BORDER).mean() > 0.9


def test_ranges_of_either_sign_are_searched_and_one_outside_is_refused():
    pair = rendered(np.full((HEIGHT, WIDTH), 9.0), cloth())
    swapped = replace(pair, left=pair.right, right=pair.left)
    found = match(swapped, min_disparity_px=-20, ndisp=40)
    assert (np.abs(found.values + 9)[10:-10, 30:-30] < 0.5).mean() > 0.98
    with pytest.raises(MatchingError, match="no disparity of the range"):
        match(pair, min_disparity_px=WIDTH)


def test_colour_and_threads_and_strips():
    pair = rendered(ground(), cloth())
    one, two = match(pair, threads=1), match(pair, threads=2)
    for field in fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
    left, right = (np.repeat(view[..., None], 3, 2) for view in (pair.left, pair.right))
    coloured = match(replace(pair, left_rgb=left, right_rgb=right))
    assert np.nanmedian(np.abs(coloured.values - one.values)) < 0.02
    tall = RectifiedPair(
        *(np.tile(view, (4, 1)) for view in (pair.left, pair.right)),
        stand_in_camera(WIDTH, 4 * HEIGHT),
    )
    whole = match(tall)
    with patch.object(fine, "_VOLUME_BYTES", 1):
        strips = match(tall)
    assert strips.values.shape == whole.values.shape
    assert np.nanmedian(np.abs(strips.values - whole.values)) < 0.02
    assert (strips.valid == whole.valid).mean() > 0.97


def test_descriptions_are_of_unit_length_and_the_same_in_pieces():
    image = fine_grey(rendered(ground(), cloth()).left, None)
    described = Describer(load_network(), image, float(image.mean()))
    with ThreadPoolExecutor(2) as pool:
        whole = described.describe(0, 97, pool, 2)
        parts = [
            described.describe(first, min(first + 32, 97), pool, 1) for first in range(0, 97, 32)
        ]
    assert whole.shape[:2] == (97, 48 // 2)
    assert whole.shape[2] >= WIDTH
    features = np.ascontiguousarray(whole[:, :, :WIDTH]).view(np.int16).astype(float)
    squares = (features**2).sum(axis=1).reshape(97, WIDTH, 2).sum(axis=2)
    np.testing.assert_allclose(np.sqrt(squares) / UNIT, 1, atol=1e-3)
    np.testing.assert_array_equal(np.concatenate(parts)[:, :, :WIDTH], whole[:, :, :WIDTH])


@pytest.mark.slow
@pytest.mark.real
def test_half_size_scenes_are_better_than_those_of_sgm(recon_data, tmp_path):
    scenes = recon_data / "middlebury" / "MiddEval3"
    figures = run_middlebury(
        scenes / "trainingH",
        matchers=["sgm", "fine"],
        truth=scenes / "trainingQ",
        out=tmp_path,
    ).to_json()
    for limit, ratio in (("1", 0.9), ("2", 0.85)):
        each = [
            figures["matchers"][n]["weighted"]["nonocc"]["dense"]["bad"][limit]
            for n in ("sgm", "fine")
        ]
        assert 0.3 * each[0] < each[1] < ratio * each[0]
