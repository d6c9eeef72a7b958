"""What is measured between places, against figures by hand, and which points limits keep."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.values import PointCloud
from recon.report.scene import Points
from recon.view.tools import LIMITS, TOOLS, ends_of, measure, within

NAN = float("nan")


def figures(tool: str, places: list, sigma: object = NAN, ground_m: float = NAN) -> dict:
    """Figures by name: value and standard deviation, None = not said."""
    xyz = np.array(places, np.float64).reshape(-1, 3)
    found = {}
    for line in measure(tool, xyz, np.broadcast_to(sigma, len(xyz)), ground_m):
        name, said = line.split(": ")
        numbers = [float(one) for one in re.findall(r"-?\d+\.?\d*", said)]
        found[name] = (*numbers, None) if len(numbers) == 1 else tuple(numbers)
    return found


def test_a_distance_is_that_of_pythagoras_and_its_sigma_that_of_both_ends():
    found = figures("distance", [(1, 2, 3), (4, 6, 15)], [0.3, 0.4])
    assert found["distance"] == (13.0, 0.5)
    assert found["horizontal"] == (5.0, 0.5)
    assert found["height difference"] == (12.0, 0.5)


def test_a_corner_of_a_straight_path_adds_nothing_to_its_sigma():
    found = figures("distance", [(0, 0, 0), (5, 0, 0), (10, 0, 0)], [0.03, 5.0, 0.04])
    assert found["distance"] == (10.0, 0.05)


@pytest.mark.parametrize("corners", [[0, 1, 2, 3], [3, 2, 1, 0], [2, 3, 0, 1]])
def test_the_area_of_a_tilted_rectangle_and_of_its_shadow(corners):
    rectangle = np.array([(7, 0, 0), (11, 0, 3), (11, 2, 3), (7, 2, 0)], np.float64)
    found = figures("area", rectangle[corners], 0.1)
    area, sigma = found["area"]
    assert area == 10.0
    # Each corner moves it by half of a diagonal, across; four of sigma 0.1.
    assert sigma == pytest.approx(0.1 * np.sqrt(29.0), abs=0.005)
    assert found["seen from above"][0] == 8.0


def test_a_height_is_above_the_ground_or_not_known():
    assert figures("height", [(0, 0, 2.5)], 0.05, -1.5) == {"above the ground": (4.0, 0.05)}
    assert measure("height", np.zeros((1, 3)), np.array([0.05]), NAN) == [
        "above the ground: not known there"
    ]


def test_without_a_sigma_of_each_place_that_counts_none_is_said():
    assert figures("distance", [(0, 0, 0), (3, 4, 0)])["distance"] == (5.0, None)
    assert figures("distance", [(0, 0, 0), (3, 4, 0)], [0.1, NAN])["distance"] == (5.0, None)


@pytest.mark.parametrize(("tool", "clicked"), [("distance", 1), ("area", 2)])
def test_too_few_places_are_counted(tool, clicked):
    (line,) = measure(tool, np.zeros((clicked, 3)), np.zeros(clicked), 0.0)
    assert line == f"{clicked} of {clicked + 1} places clicked"


@settings(deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-100, 100)] * 3), min_size=3, max_size=6),
    st.floats(-np.pi, np.pi), st.tuples(*[st.floats(-100, 100)] * 3),
)  # fmt: skip
def test_moving_and_turning_about_z_changes_no_figure(places, angle, by):
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    xyz = np.array(places)
    for _, figures_of in TOOLS.values():
        for of in figures_of.values():
            moved = of(xyz @ turn.T + by, 3.0 + by[2])
            assert moved == pytest.approx(of(xyz, 3.0), abs=1e-6)


def known_points() -> Points:
    xyz = np.array([(0, 0, 0), (5, -1, 1), (9, 2, 3)], np.float32)
    age = np.array([0, np.nan, 8], np.float32)
    return Points("", PointCloud(xyz, time_s=age, session=np.array([0, 1, 2], np.int32)))


@pytest.mark.parametrize(
    ("by", "limits", "kept"),
    [
        ("x", (1, 9), [1, 2]), ("y", (-5, 0), [0, 1]), ("height", (0.5, 2), [1]),
        ("age", (1, 9), [1, 2]), ("session", (0, 1), [0, 1]), ("sigma", (0, 0), [0, 1, 2]),
    ],
)  # fmt: skip
def test_points_are_kept_within_limits_and_where_a_value_is_not_known(by, limits, kept):
    assert np.flatnonzero(within(known_points(), {by: limits})).tolist() == kept


def test_ends_are_whole_numbers_around_most_points_or_zeros():
    parts = [Points("", PointCloud(np.random.default_rng(0).random((4000, 3), np.float32)))]
    assert {by: ends_of(parts, by) for by in LIMITS} == {
        "x": (0, 1), "y": (0, 1), "height": (0, 1), "age": (0, 0), "session": (0, 0),
    }  # fmt: skip
    assert ends_of([], "x") == (0, 0)
