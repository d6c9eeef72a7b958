"""The figures of an accuracy report, by hand."""

import numpy as np
import pytest

from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.export.accuracy import ErrorFigures, _statement
from recon.map.sessions.georeference import Georeference
from recon.map.sessions.measured import Survey

OFF_M = np.array([[0.03, -0.04, 0.1], [-0.01, 0.02, -0.3], [0.05, 0.0, 0.05]])


def test_errors_are_means_and_roots_of_mean_squares_by_axis():
    found = ErrorFigures.of(OFF_M)
    assert found.points == 3
    by_hand = {
        "east": ((0.03**2 + 0.01**2 + 0.05**2) / 3) ** 0.5,
        "north": ((0.04**2 + 0.02**2) / 3) ** 0.5,
        "up": ((0.1**2 + 0.3**2 + 0.05**2) / 3) ** 0.5,
        "horizontal": ((0.03**2 + 0.01**2 + 0.05**2 + 0.04**2 + 0.02**2) / 3) ** 0.5,
        "3d": (np.sum(np.square(OFF_M)) / 3) ** 0.5,
    }
    assert found.rmse_m == pytest.approx(by_hand, rel=1e-12)
    assert found.mean_m == pytest.approx({"east": 0.07 / 3, "north": -0.02 / 3, "up": -0.05})


def test_the_error_of_the_survey_counts_in_each_coordinate_as_asprs_has_it():
    """RMSE_H² = RMSE_H1² + RMSE_H2², where the survey's RMSE_H2 is of both coordinates."""
    plain, tested = ErrorFigures.of(OFF_M), ErrorFigures.of(OFF_M, 0.02)
    for axis, coordinates in {"up": 1, "horizontal": 2, "3d": 3}.items():
        square = plain.rmse_m[axis] ** 2 + coordinates * 0.02**2
        assert tested.rmse_m[axis] == pytest.approx(square**0.5, rel=1e-12)
    assert tested.mean_m == plain.mean_m


@pytest.mark.parametrize(
    ("count", "said"),
    [
        (0, "No check points: nothing independent says how accurate the map is."),
        (1, "1 check point: too few for a statement by ASPRS (30)."),
        (29, "29 check points: too few for a statement by ASPRS (30)."),
        (30, "Tested by 30 check points (ASPRS, edition 2, 2023): RMSE_H 0.141 m, RMSE_V 0.100 m."),
    ],
)
def test_too_few_check_points_are_no_statement(count, said):
    assert _statement(ErrorFigures.of(np.full((count, 3), 0.1)) if count else None) == said


def test_places_are_as_uncertain_as_turns_and_shifts_of_the_map_make_them():
    """Against samples of the rotation and the shift: a covariance of 4000 is known to 7 %."""
    turn = np.diag([1e-4, 4e-4, 9e-4]) + 5e-5
    middle_m = np.array([4.5e5, 5.4e6, 100.0])
    nothing = (np.eye(4), None, np.zeros((1, 3)), 1.0, 1.0, 0, ())
    placed = Georeference(*nothing, turn, 0.0, middle_m, 0.1)
    place_m = middle_m + np.array([30.0, -20.0, 5.0])
    rng = np.random.default_rng(7)
    moved = [
        apply(make_transform(exp_so3(w), s), place_m - middle_m)
        for w, s in zip(
            rng.multivariate_normal(np.zeros(3), turn, 4000),
            rng.normal(0.0, 0.1, (4000, 3)),
            strict=True,
        )
    ]
    expected = np.cov(np.array(moved).T)
    found = placed.covariance(place_m[None])[0]
    np.testing.assert_allclose(found, expected, atol=0.07 * np.trace(expected))
    np.testing.assert_allclose(placed.covariance(middle_m[None])[0], 0.01 * np.eye(3), atol=1e-12)


def test_the_files_of_a_survey_are_those_that_it_is_read_from(tmp_path):
    oxts = tmp_path / "oxts"
    (oxts / "data").mkdir(parents=True)
    for name in ("data/0.txt", "timestamps.txt"):
        (oxts / name).write_text(name)
    (tmp_path / "drive.bag").write_text("bag")
    assert Survey(oxts).files == {
        "oxts/data/0.txt": oxts / "data/0.txt",
        "oxts/timestamps.txt": oxts / "timestamps.txt",
    }
    topic = Survey(tmp_path / "drive.bag:/fix")
    assert topic.files == {"drive.bag": tmp_path / "drive.bag"}
