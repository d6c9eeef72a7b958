"""A keyframe holds features all over the image, and words that tell places apart."""

from __future__ import annotations

import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.places.keyframe import FEATURES, make_keyframe, words_of
from recon.places.places import WordIndex
from tests.places.conftest import LAP
from tests.places.test_verify import CAMERA


def _words(block, frame: int) -> np.ndarray:
    return words_of(block.keyframe(frame).descriptors)


def test_the_same_place_is_more_alike_than_any_other(block):
    here = _words(block, 3)

    index = WordIndex()
    for frame in (LAP + 3, 60, 100):
        index.add(_words(block, frame))
    again, *elsewhere = index.likeness(here)
    assert again > 2 * max(elsewhere)


def test_features_are_spread_and_have_the_disparity_of_their_place(block):
    keyframe = block.keyframe(3)
    u, v, d = keyframe.uvd.T

    assert 100 < len(d) <= FEATURES
    columns = np.unique((u // 80).astype(int))
    assert set(columns) == {0, 1, 2, 3}
    truth = block.drive.camera.disparity_truth(3).values
    known = np.isfinite(d)
    there = truth[np.rint(v[known]).astype(int), np.rint(u[known]).astype(int)]
    # The median of nine disparities, each off by a quarter of a pixel.
    assert np.nanmedian(np.abs(there - d[known])) < 0.2
    assert known.mean() > 0.3


def test_an_image_without_texture_gives_a_keyframe_without_features():
    grey = np.full((120, 320), 90, np.uint8)
    unknown = Disparity(
        np.full(grey.shape, np.nan, np.float32),
        np.zeros(grey.shape, np.float32),
        np.full(grey.shape, np.nan, np.float32),
        np.full(grey.shape, Reason.LOW_TEXTURE, np.uint8),
    )

    keyframe = make_keyframe(0, RectifiedPair(grey, grey, CAMERA), unknown)

    assert keyframe.uvd.shape == (0, 3)
    assert words_of(keyframe.descriptors).size == 0
