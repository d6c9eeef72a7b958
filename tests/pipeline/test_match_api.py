"""`recon.match`: two images in, a disparity out, with any matcher."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import recon
from recon.errors import SettingsError


@pytest.fixture(scope="module")
def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Noise, six pixels further left in the right image."""
    world = np.random.default_rng(8).integers(0, 256, (50, 130), dtype=np.uint8)
    world = cv2.GaussianBlur(world, (3, 3), 0)
    return world[:, :120], world[:, 6:126]


@pytest.mark.parametrize("matcher", ["sad", "sgm", "opencv-bm", "opencv-sgbm"])
def test_every_matcher_finds_the_shift(
    pictures: tuple[np.ndarray, np.ndarray], matcher: str
) -> None:
    disparity = recon.match(*pictures, matcher=matcher, ndisp=16)
    # All fit parts of a pixel; a quarter is more than the bias of any of them.
    assert np.nanmedian(disparity.values) == pytest.approx(6, abs=0.25)
    # OpenCV as it comes leaves out the range at the left and half a window at each other side.
    assert disparity.valid[4:-4, 20:-4].mean() > 0.8


def test_settings_are_those_of_the_matcher_that_is_named(
    pictures: tuple[np.ndarray, np.ndarray],
) -> None:
    assert recon.match(*pictures, matcher="opencv-bm", block_px=15).values.shape == (50, 120)
    with pytest.raises(SettingsError, match="block_px"):
        recon.match(*pictures, block_px=15)
    with pytest.raises(SettingsError, match="unknown matcher"):
        recon.match(*pictures, matcher="nonsense")
