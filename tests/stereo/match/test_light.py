"""Light that differs between left and right is evened, and what does not differ is left alone."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.values import RectifiedCamera, RectifiedPair
from recon.sources.synthetic import SyntheticSource
from recon.stereo.match.light import even, fit_light, relit
from recon.stereo.match.registry import make_matcher
from recon.stereo.rectify.rectifier import Rectifier
from recon.street.settings import StreetScene

SCENE = {"width_px": 480, "height_px": 200, "focal_px": 270.0, "smooth_edges": False}


@pytest.fixture(scope="module")
def street() -> tuple[RectifiedPair, np.ndarray]:
    source = SyntheticSource(StreetScene(frames=1, **SCENE))
    frame = source.frame(0)
    pair = Rectifier(source.calibration).rectify(frame.pair)
    return pair, np.where(frame.truth.nonocc, frame.truth.values, np.nan)


def vignette(image):
    height, width = image.shape
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    return image * (1 - 0.33 * (x**2 + y**2))


LIGHTS = {
    "gain": lambda image: 0.5 * image,
    "gamma": lambda image: 255 * (image / 255) ** 1.6,
    "vignette": vignette,
}


def darker(pair, light):
    seen = np.clip(np.rint(light(pair.right.astype(float))), 0, 255)
    return replace(pair, right=seen.astype(np.uint8), right_rgb=None)


def test_a_pair_in_one_light_is_left_as_it_is(street):
    pair, _ = street
    assert even(pair) is pair


@pytest.mark.parametrize("name", LIGHTS)
def test_the_right_image_gets_the_light_of_the_left_one(street, name):
    pair, _ = street
    dark = darker(pair, LIGHTS[name])
    off, left = (
        np.abs(np.log((each.right + 1.0) / (pair.right + 1.0))) for each in (dark, even(dark))
    )
    # Surfaces shine and eight bits are coarse where it is dark; most of the change goes.
    assert np.median(left) < 0.3 * np.median(off)


@pytest.mark.parametrize("name", ["sad", "sgm"])
def test_what_is_evened_matches_nearly_as_well(street, name):
    pair, truth = street

    def bad(seen):
        values = make_matcher(name, threads=1).match(seen).values
        wrong = ~(np.abs(values - truth) <= 2)
        return float(wrong[np.isfinite(truth)].mean())

    assert bad(darker(pair, LIGHTS["gain"])) < bad(pair) + 0.02


def test_colours_are_evened_too(street):
    pair, _ = street
    half = replace(pair, right=pair.right // 2, right_rgb=pair.right_rgb // 2)
    seen = even(half)
    assert np.median(seen.right_rgb) == pytest.approx(np.median(pair.right_rgb), rel=0.1)


@pytest.mark.parametrize("shape", [(3, 40), (16, 16), (64, 5), (40, 64)])
def test_plain_and_small_images_stay_as_they_are(shape):
    camera = RectifiedCamera(
        focal_px=50.0, cx_px=8.0, cy_px=8.0, cx_right_px=8.0, baseline_m=0.1,
        width_px=shape[1], height_px=shape[0],
    )  # fmt: skip
    pair = RectifiedPair(np.full(shape, 200, np.uint8), np.zeros(shape, np.uint8), camera)
    assert even(pair) is pair


def test_images_that_do_not_belong_together_have_no_light_in_common(street):
    pair, _ = street
    noise = np.random.default_rng(0).integers(0, 90, pair.right.shape).astype(np.uint8)
    seen = even(replace(pair, right=noise, right_rgb=None))
    assert seen.right.std() <= 6 * noise.std()  # a factor is bounded
    assert fit_light(pair, np.full(pair.left.shape, np.nan, np.float32)) is None


def test_no_weight_changes_nothing():
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    np.testing.assert_array_equal(relit(image, np.zeros(7)), image)
