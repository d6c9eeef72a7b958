"""Dense maps: what planes of segments fill, what they leave, and what is said of it."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.match.fill import fill
from recon.stereo.match.registry import make_matcher

HEIGHT, WIDTH = 120, 260
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
WALL = (12 + X / 40 + Y / 50).astype(np.float32)


def pair_of(left: np.ndarray, right: np.ndarray | None = None) -> RectifiedPair:
    views = [view.astype(np.uint8) for view in (left, left if right is None else right)]
    return RectifiedPair(*views, stand_in_camera(left.shape[1], left.shape[0]))


def seen(values: np.ndarray, confidence: float = 0.9) -> Disparity:
    known = np.isfinite(values)
    return Disparity(
        values=values.astype(np.float32),
        confidence=np.where(known, confidence, 0).astype(np.float32),
        sigma_px=np.where(known, 0.2, np.nan).astype(np.float32),
        reason=np.where(known, Reason.VALID, Reason.LOW_TEXTURE).astype(np.uint8),
    )


def test_a_hole_of_a_plain_wall_is_filled_with_its_plane_and_said():
    values = WALL.copy()
    values[20:100, 60:200] = np.nan
    found = fill(pair_of(np.full(WALL.shape, 120)), seen(values), 2)
    hole = np.isnan(values)
    assert np.abs(found.values - WALL)[hole].max() < 0.1
    np.testing.assert_array_equal(found.reason == Reason.FILLED, hole)
    np.testing.assert_array_equal(found.values[~hole], values[~hole])
    # Of what only planes explain less is promised.
    assert found.confidence[hole].max() < 0.9
    assert found.sigma_px[hole].min() > 0.2


def test_unlikely_disparities_are_replaced_and_likely_ones_and_borders_stay():
    values = WALL.copy()
    values[40:60, 100:120] += 2
    likely = seen(values)
    doubted = np.where(values != WALL, np.float32(0.3), likely.confidence)
    plain = pair_of(np.full(WALL.shape, 120))
    assert np.abs(fill(plain, replace(likely, confidence=doubted), 1).values - WALL).max() < 0.1
    np.testing.assert_array_equal(fill(plain, likely, 1).values, values)
    reason = likely.reason.copy()
    reason[:, :10] = Reason.BORDER
    none = reason == Reason.BORDER
    bordered = Disparity(
        values=np.where(none, np.float32(np.nan), values),
        confidence=np.where(none, np.float32(0), likely.confidence),
        sigma_px=np.where(none, np.float32(np.nan), likely.sigma_px),
        reason=reason,
    )
    assert (fill(plain, bordered, 1).reason[:, :10] == Reason.BORDER).all()


def test_planes_do_not_lead_to_what_was_seen_nowhere_around():
    values = np.full(WALL.shape, np.nan, np.float32)
    values[:, :60] = (40 - X / 2)[:, :60]  # steep; on the right it would be behind the camera
    found = fill(pair_of(np.full(WALL.shape, 120)), seen(values), 1)
    assert np.nanmin(found.values) >= np.nanmin(values)
    assert np.isnan(found.values[:, 120:]).all()


@pytest.mark.parametrize("level", [1, 254])
def test_in_black_and_in_white_nothing_is_measured_nor_inferred(level):
    image = np.full(WALL.shape, 120)
    image[30:90, 80:160] = level
    found = fill(pair_of(image), seen(WALL), 1)
    assert (found.reason[35:85, 85:155] == Reason.LOW_TEXTURE).all()
    assert found.measured[:25].all()


@pytest.mark.parametrize("reason", [Reason.OUT_OF_RANGE, Reason.BORDER])
def test_what_is_beyond_the_range_or_the_image_is_not_inferred(reason):
    hole = np.zeros(WALL.shape, bool)
    hole[30:90, 80:160] = True
    given = seen(WALL).reject(hole, reason)
    found = fill(pair_of(np.full(WALL.shape, 120)), given, 1)
    assert (found.reason[35:85, 85:155] == reason).all()


def test_a_plane_seen_along_one_edge_alone_is_not_continued():
    values = WALL.copy()
    values[20:] = np.nan
    found = fill(pair_of(np.full(WALL.shape, 120)), seen(values), 1)
    assert not found.inferred.any()


def test_where_nothing_was_seen_nothing_is_filled():
    nothing = seen(np.full(WALL.shape, np.nan, np.float32))
    assert not fill(pair_of(np.full(WALL.shape, 120)), nothing, 1).valid.any()


@pytest.mark.parametrize("matcher", ["sad", "sgm", "opencv-sgbm"])
def test_any_matcher_fills_what_is_plain_and_leaves_the_half_shadow(matcher):
    rng = np.random.default_rng(0)
    wall = 120 + 40 * cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH + 64)), (0, 0), 1.2)
    wall[30:90, 120:220] = 120
    left, right = wall[:, :WIDTH].copy(), wall[:, 4 : WIDTH + 4].copy()
    square = rng.uniform(0, 255, (60, 30))
    left[30:90, 60:90], right[30:90, 40:70] = square, square
    noisy = [np.clip(np.rint(v + rng.normal(0, 0.7, v.shape)), 0, 255) for v in (left, right)]
    matching, unfilled = (
        load_config(None, ["matching.ndisp=48", f"matching.fill={fill}"]).matching
        for fill in ("true", "false")
    )
    pair = pair_of(*noisy)
    one, two = (make_matcher(matcher, matching, threads).match(pair) for threads in (1, 2))
    for field in fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
    without = make_matcher(matcher, unfilled).match(pair)
    plain = np.s_[40:80, 135:205]
    right_now, before = ((np.abs(found.values[plain] - 4) < 1).mean() for found in (one, without))
    assert right_now > 0.85
    assert right_now >= before
    shadow = np.s_[35:85, 48:58]  # of the wall, behind the square in the right view
    occluded = without.reason[shadow] == Reason.OCCLUDED
    taken = occluded & (one.reason[shadow] != Reason.OCCLUDED)
    assert taken.sum() <= 0.1 * occluded.sum()
