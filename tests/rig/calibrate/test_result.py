"""Figures, text and files of a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from recon.core.values import StereoCalibration
from recon.core.values.board import parse_board
from recon.io.cameras.calibration import read_calibration
from recon.rig.calibrate.board_views import BoardViews
from recon.rig.calibrate.bootstrap import measure_spread
from recon.rig.calibrate.result import (
    CalibrationForm,
    describe_calibration,
    describe_depths,
    write_calibration,
)
from recon.rig.calibrate.stereo import calibrate_stereo
from recon.rig.settings import CalibratedSettings, CalibrationSettings

SIZE = (640, 480)


def test_figures_and_files_are_those_of_the_rig_and_its_views(make_views, tmp_path: Path) -> None:
    rig, views = make_views(count=12)
    settings = CalibrationSettings(radial_terms=2)
    fit = calibrate_stereo(views, SIZE, settings)
    seen = BoardViews(tuple(views), {}, (), SIZE, 14, parse_board("chess:9x6:25mm"))
    spread = measure_spread(fit, settings)
    config = CalibratedSettings(calibration=settings)
    run = describe_calibration(seen, fit, spread, config)
    found = run.summary
    assert found["baseline_squares"] == pytest.approx(rig.baseline_m / 0.025, rel=0.01)
    assert 0.05 < found["epipolar_px"] < found["epipolar_95_px"] < 0.5
    normals = np.array([abs(T[2, 2]) for T in fit.state.T_rig_board])
    assert found["tilt_max_deg"] == pytest.approx(np.degrees(np.arccos(normals.min())))
    assert found["tilted_share"] == np.mean(normals <= np.cos(np.radians(20)))
    away = [np.linalg.norm(T[:3, :3] @ [0.1, 0.0625, 0] + T[:3, 3]) for T in fit.state.T_rig_board]
    assert found["far_to_near"] == pytest.approx(max(away) / min(away), rel=1e-6)
    pixels = np.concatenate([view.seen[0].pixels for view in views])
    cells = {(int((u + 0.5) // 80), int((v + 0.5) // 80)) for u, v in pixels}
    assert found["coverage_left"] == len(cells) / 48
    assert found["depth_error_cm"]["2"]["high"] == pytest.approx(100 * spread.depths[0].high_m)
    found["verdict"] = "good"
    for form in get_args(CalibrationForm):
        files = write_calibration(tmp_path / form / "rig.yaml", run, form)
        read = read_calibration(files[0], *SIZE)
        assert isinstance(read, StereoCalibration)
        assert read.baseline_m == pytest.approx(fit.calibration.baseline_m)


def test_depth_errors_are_said_with_two_digits() -> None:
    known = {"calibration": 1.234, "low": -12.6, "high": 0.5, "matching": 33.4}
    unknown = {"calibration": None, "low": None, "high": None, "matching": 400.0}
    working = {"distance_m": 4.321, "calibration_share": 0.0123}
    summary = {"working_error": working, "depth_error_cm": {"2": known, "9": unknown}}
    assert describe_depths(summary) == {
        "depth error at the working distance of 4.32 m": "1.2 %",
        "depth error at 2 m": "1.2 cm, in the middle -13 to 0.5; of matching 33 cm",
        "depth error at 9 m": "no common view; of matching 400 cm",
    }
    working["calibration_share"] = None
    assert "unknown" in describe_depths(summary).values()
