"""Questions to all places at once give what questions to each would give."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.geometry import se3
from recon.core.values import Trajectory
from recon.places import places as places_file
from recon.places.places import (
    SIGMAS,
    Place,
    Places,
    WordIndex,
    drift_at_end,
    drift_over,
    fit_to_path,
    most_alike,
)

images = st.lists(st.sets(st.integers(0, 30)), max_size=20)


def _sorted(words) -> np.ndarray:
    return np.array(sorted(words), np.uint32)


@given(images, st.sets(st.integers(0, 30)))
def test_likeness_is_the_share_of_words_in_common_of_which_rare_ones_count_more(known, asked):
    index = WordIndex()
    for words in known:
        index.add(_sorted(words))
    having = {word: sum(word in words for words in known) for word in asked}
    total = np.log(max(len(known), 1) + 1)
    weight = {word: 1.0 - np.log(max(n, 1)) / total for word, n in having.items()}
    expected = [
        sum(weight[k] for k in words & asked) / np.sqrt(max(len(words) * len(asked), 1))
        for words in known
    ]
    np.testing.assert_allclose(index.likeness(_sorted(asked)), expected, rtol=1e-12, atol=1e-15)


def test_likeness_is_that_of_the_right_image_among_many():
    rng = np.random.default_rng(0)
    images = [np.unique(rng.integers(0, 1 << 20, 20, np.uint32)) for _ in range(900)]
    index = WordIndex()
    for words in images:
        index.add(words)
    for number in (0, 255, 256, 511, 512, 700, 899):
        alike = index.likeness(images[number])
        assert alike[number] > 0.9
        assert np.delete(alike, number).max() < 0.2


REACH_M = 12.0


def _place(
    frame: int, x_m: float, path_m: float, turned_deg: float = 0.0, segment: int = 0
) -> Place:
    R = se3.exp_so3(np.array([0.0, np.radians(turned_deg), 0.0]))
    T = se3.make_transform(R, np.array([x_m, 0.0, 0.0]))
    return Place(frame, T, path_m, segment, REACH_M, np.zeros(0, np.uint32))


def test_a_place_is_near_if_odometry_could_be_so_wrong():
    far = drift_over(100.0)
    reach_m = REACH_M + SIGMAS * far.position_m
    turn_deg = places_file.VIEW_DEG + np.degrees(SIGMAS * far.angle_rad)
    places = Places()
    for ratio in (0.0, 0.99, 1.01):
        places.add(_place(len(places), ratio * reach_m, 0.0))
    for ratio in (0.99, 1.01):
        places.add(_place(len(places), 0.0, 0.0, ratio * turn_deg))
    places.add(_place(9, 0.0, 100.0 - 0.9 * places_file._BETWEEN * REACH_M))
    places.add(_place(10, 0.0, 0.0, segment=1))
    near = places.near(_place(11, 0.0, 100.0))
    assert near.tolist() == [True, True, False, True, False, False, False]


def test_places_keep_what_they_are_given_beyond_their_first_size():
    places = Places()
    for k in range(200):
        places.add(_place(k, float(k), 2.0 * k))
    assert places.frames == list(range(200))
    assert np.array_equal(places.path_m, 2.0 * np.arange(200))
    assert np.array_equal(places.T_world_camera[:, 0, 3], np.arange(200.0))


@pytest.mark.slow
def test_a_question_after_ten_kilometres_takes_milliseconds():
    rng = np.random.default_rng(0)
    places = Places()
    for k in range(6700):
        words = np.unique(rng.integers(0, 1 << 22, 2000, np.uint32))
        places.add(Place(k, np.eye(4), 1.5 * k, 0, REACH_M, words))
    asked = Place(6700, np.eye(4), 1.5 * 6700, 0, REACH_M, words)
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        places.near(asked)
        places.likeness(asked)
        seconds.append(time.perf_counter() - start)
    # Ten milliseconds on an idle core; comparing image with image takes half a second.
    assert min(seconds) < 0.1


def test_the_most_alike_images_stand_apart():
    stands_m = np.array([[0.0], [1.0], [4.0], [9.0], [20.0], [30.0]])
    likeness = np.array([0.5, 0.9, 0.8, 0.7, 0.6, 1.0])
    for worth, chosen in ((range(5), [1, 3, 4]), (range(2), [1]), ((0, 2), [2, 0])):
        # 4 m are enough.
        assert [*most_alike(likeness, np.array(worth), stands_m, 8.0)] == chosen


@pytest.mark.parametrize(("scale", "off_m"), [(1.0, 0.0), (1.05, 0.0), (1.0, 0.5)])
def test_a_fit_to_a_path_states_misfit_and_scale(scale, off_m):
    angle = np.linspace(0.0, 3.0, 60)
    ours_m = 40.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.1 * angle])
    zigzag = off_m * (-1.0) ** np.arange(60)
    there = ours_m + np.outer(zigzag, [0.0, 0.0, 1.0])
    turned = se3.exp_so3(np.array([0.3, -0.2, 1.0]))
    found = fit_to_path(ours_m, scale * there @ turned.T + [500.0, 20.0, 3.0], 1.0, 0.1)
    assert found.scale == pytest.approx(scale, rel=1e-3)
    assert found.scaled_m == pytest.approx(off_m, rel=0.01, abs=1e-9)
    spread_m = np.sqrt(np.square(ours_m - ours_m.mean(axis=0)).sum(axis=1).mean())
    assert found.rms_m == pytest.approx(np.hypot(off_m, (scale - 1) * spread_m), rel=0.02, abs=1e-9)
    assert found.most_m == pytest.approx(SIGMAS * np.hypot(1.0, 0.1))


def test_the_drift_at_the_end_is_what_is_possible_or_what_is_stated_if_that_is_more():
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 2, 3] = np.arange(101)
    path = Trajectory(poses, np.arange(101.0))
    assert drift_at_end(path) == pytest.approx(drift_over(100.0).position_m)
    assert drift_at_end(path, stated_percent=50.0) == pytest.approx(50.0)
