from __future__ import annotations

from typing import Any

import pytest

from recon.core.values.board import parse_board
from recon.rig.calibrate.verdict import judge_calibration, verdict_of_calibration
from recon.sources.image_names import ImagePairs

PAIRS = ImagePairs((), by_order=False)


def figures(**other: Any) -> dict[str, Any]:
    """The figures of a good calibration, with some of them replaced."""
    good = {
        "working_error": {"distance_m": 4.0, "calibration_share": 0.01, "matching_share": 0.02},
        "views_used": 25, "views_dropped": [], "views_repeated": [], "pictures_without_board": [],
        "coverage_left": 0.9, "coverage_right": 0.9, "tilted_share": 0.7, "far_to_near": 3.0,
        "stereo_rms_px": 0.2, "left_rms_px": 0.2, "right_rms_px": 0.2, "epipolar_95_px": 0.3,
        "baseline_m": 0.12, "focal_px": 500.0, "focal_interval_px": [499.0, 501.0],
    }  # fmt: skip
    return good | other


def error(share: float | None) -> dict[str, Any]:
    return {"working_error": {"distance_m": 4.0, "calibration_share": share}}


def judge(board: str = "chess:9x6:25mm", **other: Any) -> tuple[str, dict[str, str]]:
    found = judge_calibration(parse_board(board), PAIRS, figures(**other))
    return verdict_of_calibration(found), {finding.code: finding.text for finding in found}


@pytest.mark.parametrize(
    ("share", "verdict"),
    [(0.005, "good"), (0.019, "good"), (0.03, "usable"), (0.06, "repeat"), (None, "repeat")],
)
def test_the_verdict_is_that_of_the_depth_error_at_the_working_distance(
    share: float | None, verdict: str
) -> None:
    assert judge(**error(share))[0] == verdict


def test_the_depth_error_is_said_as_a_length_and_a_share() -> None:
    for board, said in (
        ("chess:9x6:25mm", "at 4 m is expected to be wrong by 24 cm (6.0 %)"),
        ("chess:9x6", "at 4 squares is expected to be wrong by 0.24 squares"),
    ):
        assert said in judge(board, **error(0.06))[1]["depth"]


@pytest.mark.parametrize(
    ("other", "code", "figure"),
    [
        ({"views_used": 8}, "views", "8 different views"),
        ({"coverage_right": 0.4}, "coverage", "40 % of the right"),
        ({"stereo_rms_px": 0.7}, "together", "worse than alone"),
        ({"epipolar_95_px": 1.4}, "rows", "1.40 px"),
        ({"baseline_m": 12.0}, "baseline", "12 m: are the squares really 25 mm"),
    ],
)
def test_what_makes_the_forecast_doubtful_makes_it_usable_at_best(
    other: dict[str, Any], code: str, figure: str
) -> None:
    verdict, found = judge(**other)
    assert verdict == "usable"
    assert figure in found[code]


@pytest.mark.parametrize(
    ("other", "code", "figure"),
    [
        ({"coverage_left": 0.67}, "corners", "67 % of the left"),
        ({"tilted_share": 0.2}, "tilt", "20 degrees or more in 20 %"),
        ({"far_to_near": 1.2}, "distances", "1.2 times"),
        ({"focal_interval_px": [480.0, 520.0]}, "focal", "480.0 to 520.0 px"),
        ({"views_used": 13}, "more", "13 different ones"),
        ({"stereo_rms_px": 0.6, "left_rms_px": 0.6}, "sharpness", "0.60 px"),
        ({}, "more", "lack nothing"),
    ],
)
def test_what_the_views_lack_is_said_when_depth_is_not_good(
    other: dict[str, Any], code: str, figure: str
) -> None:
    verdict, found = judge(**error(0.04), **other)
    assert verdict == "usable"
    assert set(found) == {"depth", code}
    assert figure in found[code]
    assert judge(**other) == ("good", {})


def test_what_was_left_out_is_noted_and_changes_no_verdict() -> None:
    verdict, found = judge(
        "chess:9x6",
        views_dropped=["a.png"],
        views_repeated=["b.png", "c.png"],
        pictures_without_board=["d.png"],
    )
    assert verdict == "good"
    assert set(found) == {"square", "board", "dropped", "repeats"}
    assert found["repeats"].startswith("2 views with the board where another one has it")
