"""Keyframes hold features and words, and tell two views of one place from two places."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.errors import ShapeError
from recon.core.geometry import se3
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.core.values.camera import project
from recon.places import verify as verify_file
from recon.places.keyframe import FEATURES, WORDS, Keyframe, make_keyframe, points_of, words_of
from recon.places.verify import MIN_INLIERS, Seen, dense_agreement, find_motion, refine, verify
from tests.places.conftest import LAP

CAMERA = RectifiedCamera(180.0, 159.5, 59.5, 159.5, 0.54, 320, 120)


def test_features_are_spread_and_have_the_disparity_of_their_place(block):
    keyframe = block.keyframe(3)
    u, v, d = keyframe.uvd.T
    assert 100 < len(d) <= FEATURES
    assert set((u // 80).astype(int)) == {0, 1, 2, 3}
    truth = block.camera.disparity_truth(3).values
    known = np.isfinite(d)
    there = truth[np.rint(v[known]).astype(int), np.rint(u[known]).astype(int)]
    # The median of nine disparities, each off by a quarter of a pixel.
    assert np.nanmedian(np.abs(there - d[known])) < 0.2
    assert known.mean() > 0.3


def test_descriptors_are_those_of_detecting_and_describing_at_once(block, monkeypatch):
    kept, sift = block.keyframe(3), cv2.SIFT.create(contrastThreshold=0.015)

    class AtOnce:
        def detect(self, image):
            self.corners, self.sifts = sift.detectAndCompute(image, None)
            return self.corners

        def compute(self, image, corners):
            place = {id(corner): n for n, corner in enumerate(self.corners)}
            return corners, self.sifts[[place[id(corner)] for corner in corners]]

    monkeypatch.setattr(cv2.SIFT, "create", lambda **_: AtOnce())
    again = make_keyframe(3, *block.frame(3))
    np.testing.assert_array_equal(again.descriptors, kept.descriptors)
    np.testing.assert_array_equal(again.uvd, kept.uvd)


def test_an_image_without_texture_gives_a_keyframe_without_features():
    grey = np.full((120, 320), 90, np.uint8)
    unknown = Disparity.from_values(np.full(grey.shape, np.nan, np.float32))
    keyframe = make_keyframe(0, RectifiedPair(grey, grey, CAMERA), unknown)
    assert keyframe.uvd.shape == (0, 3)
    assert words_of(keyframe.descriptors).size == 0


def test_a_keyframe_has_nothing_of_what_was_inferred():
    pair, flat = _textured((800, 400))
    reason = flat.reason.copy()
    reason[:, 400:] = Reason.FILLED
    both = replace(flat, reason=reason)
    keyframe, alone = make_keyframe(0, pair, both), make_keyframe(0, pair, both.only_measured())
    np.testing.assert_array_equal(keyframe.uvd, alone.uvd)
    np.testing.assert_array_equal(keyframe.coarse, alone.coarse)
    assert np.isnan(keyframe.uvd[keyframe.uvd[:, 0] > 401, 2]).all()
    assert np.isfinite(keyframe.coarse).mean() == 0.5


def _textured(size: tuple[int, int]) -> tuple[RectifiedPair, Disparity]:
    """A wall of patches of all sizes, seen at some size (width, height)."""
    rng = np.random.default_rng(3)
    grey = np.zeros((400, 800))
    for cell in (4, 8, 16, 32):
        noise = rng.uniform(0, 255, (400 // cell, 800 // cell))
        grey += cv2.resize(noise, (800, 400), interpolation=cv2.INTER_CUBIC)
    image = np.clip(grey / 4, 0, 255).astype(np.uint8)
    seen = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    camera = RectifiedCamera(400.0, 399.5, 199.5, 399.5, 0.5, 800, 400).resized(*size)
    flat = Disparity.from_values(np.full(seen.shape, 20.0, np.float32))
    return RectifiedPair(seen, seen, camera), flat


def _agreeing(first: Keyframe, last: Keyframe, scale: float) -> int:
    """Count mutually best matches that lie where they should."""
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(
        first.descriptors, last.descriptors
    )
    there = (first.uvd[[m.queryIdx for m in pairs], :2] + 0.5) * scale - 0.5
    off = np.abs(last.uvd[[m.trainIdx for m in pairs], :2] - there).max(axis=1)
    return int((off < 1.5).sum())


def test_features_are_the_same_at_half_the_size():
    large, small = (make_keyframe(0, *_textured(size)) for size in ((800, 400), (400, 200)))
    assert _agreeing(large, small, 0.5) > 100
    assert (small.uvd[:, :2] < [400, 200]).all()


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


@pytest.mark.parametrize("k", [2, 3, 4, 6])
def test_the_same_place_a_lap_later_is_recognised_to_centimetres(block, k):
    loop = verify(block.keyframe(k), block.keyframe(LAP + k), CAMERA).loop
    off = se3.invert(block.motion(k, LAP + k)) @ loop.T_first_last
    # Disparities are off by 0.25 px, 5 cm at 7 m; over a hundred matches share that.
    assert np.linalg.norm(off[:3, 3]) < 0.1
    assert np.degrees(se3.angle_rad(off)) < 0.3
    assert loop.inliers > 50
    assert loop.dense_ratio > 0.9
    # Off by at most four standard deviations in each direction.
    step = np.concatenate([off[:3, 3], se3.log_so3(off[:3, :3])])
    assert (np.abs(step) < 4 * np.sqrt(np.diag(np.linalg.inv(loop.information)))).all()


@pytest.mark.parametrize(("first", "last"), [(3, LAP + 5), (20, 23), (30, 33)])
def test_a_place_is_recognised_from_another_distance_and_direction(block, first, last):
    loop = verify(block.keyframe(first), block.keyframe(last), CAMERA).loop
    off = se3.invert(block.motion(first, last)) @ loop.T_first_last
    assert np.linalg.norm(off[:3, 3]) < 0.2
    assert np.degrees(se3.angle_rad(off)) < 0.5


@pytest.mark.parametrize(
    ("offset_m", "least", "most"),
    [
        ((0.0, 0.0, 0.0), 0.9, 1.0),
        ((3.0, 0.0, 0.0), 0.0, 0.85),
        ((-3.0, 0.0, 0.0), 0.0, 0.85),
        ((0.0, -0.5, 0.0), 0.0, 0.85),
    ],
)
def test_surfaces_confirm_the_right_pose_and_contradict_a_wrong_one(block, offset_m, least, most):
    """Ground and walls of a street go on for long, so that it takes some metres."""
    first, last = block.keyframe(3), block.keyframe(LAP + 3)
    T = block.motion(3, LAP + 3) @ se3.make_transform(np.eye(3), np.array(offset_m))
    assert least < dense_agreement(first, last, T, CAMERA, CAMERA) < most


def test_matches_in_one_corner_prove_nothing(block, monkeypatch):
    first, last = block.keyframe(3), block.keyframe(LAP + 3)
    monkeypatch.setattr(verify_file, "_SPREAD_CELLS", 17)
    assert verify(first, last, CAMERA).refused == "inliers in one corner"


def _points(seed: int, count: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A motion between two frames, and points as either sees them."""
    rng = np.random.default_rng(seed)
    T = se3.make_transform(se3.exp_so3(rng.normal(0, 0.05, 3)), rng.normal(0, 0.5, 3))
    T[:3, 3] *= scale
    last_xyz = scale * rng.uniform([-4, -1.5, 6], [4, 1.5, 25], (count, 3))
    return T, se3.apply(T, last_xyz), last_xyz


def _seen(xyz: np.ndarray, noise_px: np.ndarray | float = 0.0) -> Seen:
    uvd = np.column_stack(project(xyz, CAMERA)) + noise_px
    return Seen(uvd, points_of(uvd, CAMERA), CAMERA, 1.0)


@pytest.mark.parametrize("seed", range(5))
def test_refinement_finds_the_motion_of_exact_points(seed):
    T, *xyz = _points(seed, 80)
    rng = np.random.default_rng(100 + seed)
    start = T @ se3.make_transform(se3.exp_so3(rng.normal(0, 0.01, 3)), rng.normal(0, 0.2, 3))
    aligned = refine(*map(_seen, xyz), start)
    assert np.allclose(aligned.T_first_last, T, atol=1e-6)
    assert aligned.agree.all()


@pytest.mark.parametrize("seed", range(5))
def test_a_motion_is_found_among_four_times_as_many_wrong_matches(seed):
    T, first_xyz, last_xyz = _points(seed, 200, scale=0.5)
    rng = np.random.default_rng(seed)
    right = np.arange(200) < 40
    first_xyz[~right] = rng.permutation(first_xyz[~right])
    noise = rng.normal(0.0, [0.5, 0.5, 0.25], (2, 200, 3))
    found = find_motion(_seen(first_xyz, noise[0]), _seen(last_xyz, noise[1]))
    off = se3.invert(T) @ found.T_first_last
    assert np.linalg.norm(off[:3, 3]) < 0.05
    assert np.degrees(se3.angle_rad(off)) < 0.5
    assert found.agree[right].mean() > 0.8
    assert found.agree[~right].mean() < 0.1
    wrong = find_motion(*(_seen(xyz[~right]) for xyz in (first_xyz, last_xyz)))
    assert wrong is None or wrong.agree.sum() < MIN_INLIERS
