"""Figures, text and files of a calibration, and the verdict on it."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

from recon.core.values.board import parse_board
from recon.io.cameras.calibration import read_calibration
from recon.rig.calibrate.board_views import BoardViews
from recon.rig.calibrate.figures import WorkingError
from recon.rig.calibrate.lenses import LensChoice, compare_lenses
from recon.rig.calibrate.stereo import (
    calibrate_stereo,
    measure_spread,
)
from recon.rig.calibrate.verdict import (
    describe_calibration,
    judge_calibration,
    lens_faults,
    verdict_of_calibration,
    write_calibration,
)
from recon.rig.settings import CalibratedSettings, CalibrationSettings
from recon.rig.written import CalibrationForm
from recon.sources.images import ImagePairs
from tests.scenery.calibrated import GOOD

SIZE = (640, 480)


def test_figures_and_files_are_those_of_the_rig_and_its_views(make_views, tmp_path):
    rig, views = make_views(count=12)
    settings = CalibrationSettings(radial_terms=2)
    fit = calibrate_stereo(views, SIZE, settings)
    seen = BoardViews(tuple(views), {}, (), SIZE, 14, parse_board(CHESS))
    spread = measure_spread(fit, settings)
    config = CalibratedSettings(calibration=settings)
    run = describe_calibration(seen, fit, spread, config, PAIRS)
    found = run.summary.to_json()
    assert found["baseline_squares"] == pytest.approx(rig.baseline_m / 0.025, rel=0.01)
    assert 0.05 < found["epipolar_px"] < found["epipolar_95_px"] < 0.5
    normals = np.array([abs(T[2, 2]) for T in fit.state.T_rig_board])
    assert found["tilt_max_deg"] == pytest.approx(np.degrees(np.arccos(normals.min())))
    assert found["tilted_ratio"] == np.mean(normals <= np.cos(np.radians(20)))
    away = [np.linalg.norm(T[:3, :3] @ [0.1, 0.0625, 0] + T[:3, 3]) for T in fit.state.T_rig_board]
    assert found["far_to_near"] == pytest.approx(max(away) / min(away), rel=1e-6)
    pixels = np.concatenate([view.seen[0].pixels for view in views])
    cells = {(int((u + 0.5) // 80), int((v + 0.5) // 80)) for u, v in pixels}
    assert found["coverage_left"] == len(cells) / 48
    at = f"{spread.depths[0].depth_m:g}"
    working_m = found["working_error"]["distance_m"]
    # The nearest of 1, 2 and 5 times powers of ten.
    for depth, ratio in ((spread.depths[0], 0.2), (spread.depths[-1], 2.0)):
        assert abs(np.log(depth.depth_m / (ratio * working_m))) < np.log(1.6)
    assert found["depth_error_cm"][at]["high"] == pytest.approx(100 * spread.depths[0].high_m)
    for form in get_args(CalibrationForm):
        files = write_calibration(tmp_path / form / "rig.yaml", run, form)
        read = read_calibration(files[0], *SIZE)
        assert read.baseline_m == pytest.approx(fit.calibration.baseline_m)


CHESS = "chess:9x6:25mm"
PAIRS = ImagePairs((), by_order=False)


def error(ratio: float | None) -> dict[str, Any]:
    return {"working_error": WorkingError(4.0, ratio, 0.02)}


def judge(board: str = CHESS, **other: Any) -> tuple[str, dict[str, str]]:
    found = judge_calibration(parse_board(board), PAIRS, replace(GOOD, **other))
    return verdict_of_calibration(found), {finding.code: finding.text for finding in found}


@pytest.mark.parametrize(
    ("board", "ratio", "verdict", "said"),
    [
        (CHESS, 0.005, "good", None),
        (CHESS, 0.019, "good", None),
        (CHESS, 0.03, "usable", "at 4 m is expected to be wrong by 12 cm (3.0 %)"),
        (CHESS, 0.06, "repeat", "at 4 m is expected to be wrong by 24 cm (6.0 %)"),
        ("chess:9x6", 0.06, "repeat", "at 4 squares is expected to be wrong by 0.24 squares"),
        (CHESS, None, "repeat", None),
    ],
)
def test_the_verdict_is_that_of_the_depth_error_at_the_working_distance(
    board, ratio, verdict, said
):
    given, texts = judge(board, **error(ratio))
    assert given == verdict
    assert said is None or said in texts["depth"]


@pytest.mark.parametrize(
    ("other", "code", "figure"),
    [
        ({"views_used": 8}, "views", "8 different views"),
        ({"coverage_right": 0.4}, "coverage", "40 % of the right"),
        ({"stereo_rms_px": 0.7}, "together", "worse than alone"),
        ({"epipolar_95_px": 1.4}, "rows", "1.40 px"),
    ],
)
def test_what_makes_the_forecast_doubtful_makes_it_usable_at_best(other, code, figure):
    verdict, found = judge(**other)
    assert verdict == "usable"
    assert figure in found[code]


@pytest.mark.parametrize(
    ("other", "code", "figure"),
    [
        ({"coverage_left": 0.67}, "corners", "67 % of the left"),
        ({"tilted_ratio": 0.2}, "tilt", "20 degrees or more in 20 %"),
        ({"far_to_near": 1.2}, "distances", "1.2 times"),
        ({"focal_interval_px": [480.0, 520.0]}, "focal", "480.0 to 520.0 px"),
        ({"views_used": 13}, "more", "13 different ones"),
        ({"stereo_rms_px": 0.6, "left_rms_px": 0.6}, "sharpness", "0.60 px"),
        ({}, "more", "lack nothing"),
    ],
)
def test_what_the_views_lack_is_said_when_depth_is_not_good(other, code, figure):
    verdict, found = judge(**error(0.04), **other)
    assert verdict == "usable"
    assert set(found) == {"depth", code}
    assert figure in found[code]
    assert judge(**other) == ("good", {})


def test_what_was_left_out_is_noted_and_changes_no_verdict():
    left_out = {"views_dropped": ["a.png"], "views_repeated": ["b.png", "c.png"]}
    verdict, found = judge("chess:9x6", **left_out, pictures_without_board=["d.png"])
    assert verdict == "good"
    assert set(found) == {"square", "board", "dropped", "repeats"}
    assert found["repeats"].startswith("2 views with the board where another one has it")
    for baseline_m in (0.004, 12.0):  # of an endoscope, and of a ship
        verdict, found = judge(baseline_m=baseline_m)
        assert (verdict, set(found)) == ("good", {"baseline"})
        assert f"{baseline_m:g} m: are the squares really 25 mm" in found["baseline"]


def test_a_lens_that_fits_as_well_with_fewer_coefficients_is_proposed_and_none_where_none_fits():
    rational, fisheye = (
        LensChoice(0.42, 16, 0.06, suits=True),
        LensChoice(0.43, 8, 0.01, suits=True),
    )
    lenses = {"rational": rational, "fisheye": fisheye}
    (code, figures), *others = lens_faults(lenses, "rational")
    assert (code, figures["best"], others) == ("model", "fisheye", [])
    assert "8 fewer" in figures["fewer"]
    assert not list(lens_faults(lenses, "fisheye"))
    # A lens that is good already is kept, unless it fits worse beyond chance.
    good = {**lenses, "rational": replace(rational, working_ratio=0.015)}
    assert not list(lens_faults(good, "rational"))
    worse = {**lenses, "rational": replace(rational, working_ratio=0.015, suits=False)}
    assert [code for code, _ in lens_faults(worse, "rational")] == ["model"]
    bad = {"radtan": LensChoice(0.8, 10, 0.01, suits=True)}
    assert [code for code, _ in lens_faults(bad, "radtan")] == ["lens"]


def test_a_wide_lens_is_told_from_a_rational_one_and_judged_where_the_board_was(make_views):
    _, views = make_views("fisheye", count=14, sigma_px=0.2)
    settings = CalibrationSettings(model="rational")
    fit = calibrate_stereo(views, SIZE, settings)
    lenses = compare_lenses(fit, SIZE, settings)
    assert lenses["fisheye"].suits
    assert lenses["fisheye"].held_out_px < lenses["rational"].held_out_px
    assert lenses["fisheye"].working_ratio < lenses["rational"].working_ratio / 3
    (code, figures), *_ = lens_faults(lenses, "rational")
    assert (code, figures["best"]) == ("model", "fisheye")
