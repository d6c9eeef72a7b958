"""A keyframe holds features all over the image, and words that tell places apart."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.core.errors import ShapeError
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.places.keyframe import FEATURES, WORDS, Keyframe, make_keyframe, words_of
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


def _textured(size: tuple[int, int]) -> RectifiedPair:
    """A wall of patches of all sizes, seen at some size (width, height)."""
    rng = np.random.default_rng(3)
    grey = np.zeros((400, 800))
    for cell in (4, 8, 16, 32):
        noise = rng.uniform(0, 255, (400 // cell, 800 // cell))
        grey += cv2.resize(noise, (800, 400), interpolation=cv2.INTER_CUBIC)
    image = np.clip(grey / 4, 0, 255).astype(np.uint8)
    seen = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    camera = RectifiedCamera(400.0, 399.5, 199.5, 399.5, 0.5, 800, 400).resized(*size)
    return RectifiedPair(seen, seen, camera)


def _flat(pair: RectifiedPair) -> Disparity:
    return Disparity.from_values(np.full(pair.left.shape, 20.0, np.float32))


def _agreeing(first: Keyframe, last: Keyframe, scale: float) -> int:
    """Count mutually best matches that lie where they should."""
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(
        first.descriptors, last.descriptors
    )
    there = (first.uvd[[m.queryIdx for m in pairs], :2] + 0.5) * scale - 0.5
    off = np.abs(last.uvd[[m.trainIdx for m in pairs], :2] - there).max(axis=1)
    return int((off < 1.5).sum())


def test_features_can_be_described_at_the_focal_length_of_another_camera():
    large, small = _textured((800, 400)), _textured((400, 200))
    known = make_keyframe(0, large, _flat(large))

    as_it_is = make_keyframe(1, small, _flat(small))
    zoomed = make_keyframe(1, small, _flat(small), focal_px=large.camera.focal_px)

    assert _agreeing(known, zoomed, 0.5) > 1.5 * _agreeing(known, as_it_is, 0.5)
    assert _agreeing(known, zoomed, 0.5) > 100
    assert zoomed.coarse.shape == as_it_is.coarse.shape
    assert (zoomed.uvd[:, :2] < [400, 200]).all()


def test_nearly_the_same_focal_length_changes_nothing():
    pair = _textured((400, 200))
    plain = make_keyframe(0, pair, _flat(pair))

    for focal_px in (0.95 * pair.camera.focal_px, 10.0 * pair.camera.focal_px):
        near = make_keyframe(0, pair, _flat(pair), focal_px=focal_px)
        np.testing.assert_array_equal(near.uvd, plain.uvd)
        np.testing.assert_array_equal(near.descriptors, plain.descriptors)


def test_equal_bits_of_two_tables_are_two_words():
    words = words_of(np.zeros((2, 32), np.uint8))

    assert len(words) == WORDS
    assert (np.diff(words.astype(np.int64)) > 0).all()


@pytest.mark.parametrize(
    ("uvd", "coarse"),
    [
        ([np.nan, 5.0, 1.0], [[1.0]]),
        ([3.0, 5.0, np.inf], [[1.0]]),
        ([3.0, 5.0, 1.0], [[]]),
        ([3.0, 5.0, 1.0], [[np.inf]]),
    ],
)
def test_a_keyframe_of_impossible_numbers_is_refused(uvd, coarse):
    descriptors = np.zeros((1, 32), np.uint8)
    with pytest.raises(ShapeError, match="keyframe"):
        Keyframe(0, np.float32([uvd]), descriptors, np.float32(coarse))
    Keyframe(0, np.float32([[3.0, 5.0, np.nan]]), descriptors, np.float32([[np.nan]]))
