"""Images are smoothed where noise drowns what they show, and only there."""

import numpy as np
import pytest

from recon.stereo.rectify.rectifier import noise_sigma, quieted


def seen(sigma: float, seed: int) -> np.ndarray:
    ramp = np.tile(np.linspace(60, 190, 300), (200, 1))
    noisy = ramp + np.random.default_rng(seed).normal(0.0, sigma, ramp.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [0.0, 4.0, 8.0])
def test_what_can_be_seen_stays_as_it_is(sigma):
    left, right = seen(sigma, 0), seen(sigma, 1)
    assert quieted(left, right)[0] is left


def test_noise_that_drowns_edges_is_smoothed():
    left, right = quieted(seen(14.0, 0), seen(14.0, 1))
    # A filter of one pixel leaves 0.28 of white noise.
    assert noise_sigma(left) < 0.4 * 14.0
    assert noise_sigma(right) < 0.4 * 14.0


def test_one_noisy_image_does_not_blur_the_other():
    left, right = seen(1.0, 0), seen(14.0, 1)
    assert quieted(left, right)[0] is left


def test_images_too_small_for_a_verdict_stay():
    tiny = np.zeros((2, 2), np.uint8)
    assert quieted(tiny, tiny)[0] is tiny
