"""Planes of segments, beside those that the pixels were made of."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recon.stereo.kernels import filling

DRAWS = np.random.default_rng(0).random((150, 3))
NONE = -99.0


def sorted_by_label(labels):
    starts = np.concatenate([[0], np.cumsum(np.bincount(labels.ravel()))]).astype(np.int64)
    order = np.empty(labels.size, np.int64)
    filling.sort_by_label(labels.ravel().astype(np.int32), starts, order)
    return order, starts


def fitted(values, labels, wanted, weights=None):
    weights = np.ones_like(values) if weights is None else weights
    planes = np.full((3, *values.shape), NONE, np.float32)
    order, starts = sorted_by_label(labels)
    given_ = values, weights, order, starts, np.array(wanted, np.int64), DRAWS, 1.0
    filling.fit_segments(*given_, 0, len(wanted), planes, np.empty_like(values))
    return planes


def slanted(height=60, width=80, across=0.2, down=-0.1):
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return (20 + across * x + down * y).astype(np.float32)


@given(st.lists(st.integers(0, 4), min_size=1, max_size=60))
def test_pixels_are_sorted_as_by_numpy(labels):
    labels = np.array([*labels, 0, 1, 2, 3, 4], np.int32)
    order, starts = sorted_by_label(labels)
    np.testing.assert_array_equal(order, np.argsort(labels, kind="stable"))
    assert starts[-1] == len(labels)


def test_each_segment_gets_the_plane_of_most_of_what_was_seen_in_it():
    rng = np.random.default_rng(1)
    labels = np.zeros((60, 80), np.int32)
    labels[:, 40:] = 1
    truth = np.where(labels == 0, slanted(), slanted(across=-0.3, down=0.4)).astype(np.float32)
    seen = truth + rng.normal(0, 0.1, truth.shape).astype(np.float32)
    wrong = rng.random(seen.shape) < 0.3
    seen[wrong] = rng.uniform(0, 60, wrong.sum())
    seen[10:50, 10:70] = np.nan  # only the rim is seen
    value, across, down = fitted(seen, labels, [0, 1])
    assert np.abs(value - truth).max() < 0.1
    assert np.abs(across - np.where(labels == 0, 0.2, -0.3)).max() < 0.01
    assert np.abs(down - np.where(labels == 0, -0.1, 0.4)).max() < 0.01


def test_pixels_count_by_their_weight():
    values, labels = slanted(across=0.0, down=0.0), np.zeros((60, 80), np.int32)
    values[:, 30:] += 8
    weights = np.ones_like(values)
    assert np.abs(fitted(values, labels, [0])[0] - 28).max() < 0.01
    weights[:, 30:] = 0.1
    assert np.abs(fitted(values, labels, [0], weights)[0] - 20).max() < 0.01


def test_what_has_no_plane_keeps_what_it_has():
    values, labels = slanted(), np.zeros((60, 80), np.int32)
    labels[20:40] = 1
    few = np.where(np.arange(80) < 29, values, np.nan).astype(np.float32)
    few[1:] = np.nan
    steep = slanted(across=1.9)
    noise = np.random.default_rng(0).uniform(0, 1e4, values.shape).astype(np.float32)
    for seen in (np.full_like(values, np.nan), few, steep, noise):
        assert (fitted(seen, labels, [0]) == NONE).all()
    planes = fitted(values, labels, [1])
    np.testing.assert_array_equal(planes[0] != NONE, labels == 1)


def test_points_in_a_line_give_no_steep_plane():
    values = np.full((60, 80), np.nan, np.float32)
    values[30] = 20 + 0.2 * np.arange(80)
    planes = fitted(values, np.zeros((60, 80), np.int32), [0])
    assert (planes == NONE).all()
