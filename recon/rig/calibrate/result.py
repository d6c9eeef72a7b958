"""The result of a calibration: the rig with what was measured of it, and its files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from recon.core.values.arrays import Float64
from recon.core.values.board import CalibrationBoard
from recon.io.cameras.camera_info import write_camera_info
from recon.io.cameras.kalibr import write_kalibr
from recon.io.cameras.opencv_yaml import write_opencv_calibration
from recon.io.cameras.recon_yaml import write_recon_calibration
from recon.rig.calibrate.board_views import BoardViews
from recon.rig.calibrate.bootstrap import Spread
from recon.rig.calibrate.bundle import View
from recon.rig.calibrate.settings import CalibratedSettings
from recon.rig.calibrate.stereo import StereoFit
from recon.rig.calibrate.summary import shared_pixels, summarise
from recon.stereo.rectify.rectifier import RectifyingTurns, plan_turns

CalibrationForm = Literal["recon", "opencv", "ros", "kalibr"]

# Figures that are also written into the calibration file.
_KEPT: Final = (
    "verdict", "board", "stereo_rms_px", "epipolar_px", "baseline_interval_m", "focal_interval_px",
    "views_used", "views_dropped", "depth_error_cm",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """The results of a run.

    Attributes:
        board: The board.
        config: The configuration.
        seen: The views of the board.
        fit: The calibrated rig.
        spread: Its bootstrap intervals.
        turns: Its rectifying rotations.
        rows_px: float64 (N,), row errors of all corners after rectification.
        summary: The figures of ``summary.json``.
    """

    board: CalibrationBoard
    config: CalibratedSettings
    seen: BoardViews
    fit: StereoFit
    spread: Spread
    turns: RectifyingTurns
    rows_px: Float64
    summary: dict[str, Any]


def describe_calibration(
    seen: BoardViews, fit: StereoFit, spread: Spread, config: CalibratedSettings
) -> CalibrationRun:
    """Rectify the views with the calibrated rig, and measure how well it describes them."""
    turns = plan_turns(fit.calibration, config.rectification)
    rows_px = np.concatenate([_rows_apart(turns, fit, view) for view in fit.views])
    summary = summarise(seen, fit, spread, rows_px)
    summary["rectified_focal_px"] = turns.camera.focal_px
    return CalibrationRun(seen.board, config, seen, fit, spread, turns, rows_px, summary)


def write_calibration(path: Path, run: CalibrationRun, form: CalibrationForm) -> tuple[Path, ...]:
    """Write the calibrated rig in a given format.

    Returns:
        The files: two for ROS, else one.
    """
    rig = run.fit.calibration
    if form == "ros":
        rotations = (run.turns.R_left, run.turns.R_right)
        return write_camera_info(path, rig, rotations, run.turns.camera)
    if form == "opencv":
        write_opencv_calibration(path, rig)
    elif form == "kalibr":
        write_kalibr(path, rig)
    else:
        write_recon_calibration(path, rig, {key: run.summary[key] for key in _KEPT})
    return (path,)


def _rows_apart(turns: RectifyingTurns, fit: StereoFit, view: View) -> Float64:
    """Return float64 (N,), row of each corner in the rectified left image minus the right."""
    left_px, right_px = shared_pixels(view)
    left = turns.place(fit.calibration, left_px)
    right = turns.place(fit.calibration, right_px, right=True)
    return np.asarray(left[:, 1] - right[:, 1])
