"""The result of a calibration: the rig with what was measured of it, and its files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.text import to_json
from recon.core.values import CameraIntrinsics
from recon.core.values.arrays import Float64
from recon.rig.calibrate.board_views import BoardViews
from recon.rig.calibrate.bootstrap import Spread
from recon.rig.calibrate.bundle import View
from recon.rig.calibrate.stereo import StereoFit
from recon.rig.calibrate.verdict import TILT_DEG
from recon.rig.settings import CalibratedSettings
from recon.rig.written import CalibrationForm, write_rig
from recon.stereo.rectify.rectifier import RectifyingTurns, plan_turns

_CELLS: Final = (8, 6)  # image cells; without corners in one, the lens is extrapolated there
_DEPTH_CM: Final = ("calibration", "low", "high", "matching")  # of each `DepthError`
# Figures that are also written into the calibration file.
_KEPT: Final = (
    "verdict", "board", "stereo_rms_px", "epipolar_px", "baseline_interval_m", "focal_interval_px",
    "views_used", "views_dropped", "depth_error_cm",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The results of a run."""

    config: CalibratedSettings
    seen: BoardViews
    fit: StereoFit
    spread: Spread
    turns: RectifyingTurns
    epipolar_error_px: Float64  # (N,), epipolar errors of all corners after rectification
    summary: dict[str, Any]  # the figures of ``summary.json``


def describe_calibration(
    seen: BoardViews, fit: StereoFit, spread: Spread, config: CalibratedSettings
) -> CalibrationResult:
    """Rectify the views with the calibrated rig, and measure how well it describes them."""
    turns = plan_turns(fit.calibration, config.rectification)
    rows = []
    for left_px, right_px in map(shared_pixels, fit.views):
        left = turns.place(fit.calibration, left_px)
        rows.append(left[:, 1] - turns.place(fit.calibration, right_px, right=True)[:, 1])
    epipolar_error_px = np.concatenate(rows)
    summary = _summarise(seen, fit, spread, epipolar_error_px)
    summary["rectified_focal_px"] = turns.camera.focal_px
    return CalibrationResult(config, seen, fit, spread, turns, epipolar_error_px, summary)


def write_calibration(
    path: Path, run: CalibrationResult, form: CalibrationForm | None = None
) -> tuple[Path, ...]:
    """Write the calibrated rig; see `write_rig`."""
    quality = {key: run.summary[key] for key in _KEPT}
    return write_rig(path, run.fit.calibration, run.config.rectification, form, quality)


def _summarise(
    seen: BoardViews, fit: StereoFit, spread: Spread, epipolar_error_px: Float64
) -> dict[str, Any]:
    rig, away_m = fit.calibration, _distances_m(fit)
    # Angles between the board's normal and the optical axis of the left camera.
    tilts_deg = np.degrees(np.arccos(np.clip(np.abs(fit.state.T_rig_board[:, 2, 2]), 0.0, 1.0)))
    return {
        "board": str(seen.board),
        "model": rig.left.model,
        "width_px": seen.size_px[0],
        "height_px": seen.size_px[1],
        "stereo_rms_px": fit.rms_px,
        "left_rms_px": fit.alone_px[0],
        "right_rms_px": fit.alone_px[1],
        "epipolar_px": float(np.abs(epipolar_error_px).mean()),
        "epipolar_95_px": float(np.quantile(np.abs(epipolar_error_px), 0.95)),
        "baseline_m": rig.baseline_m,
        "baseline_interval_m": list(spread.baseline_m),
        "baseline_squares": rig.baseline_m / seen.board.square_m,
        "focal_px": float(rig.left.matrix[0, 0]),
        "focal_interval_px": list(spread.focal_px),
        "focal_right_px": float(rig.right.matrix[0, 0]),
        "rotation_spread_deg": spread.rotation_deg,
        "views": seen.count,
        "views_used": len(fit.views),
        "views_repeated": list(fit.repeated),
        "views_dropped": list(fit.dropped),
        "dropped_error_px": fit.dropped,
        "pictures_without_board": [path.name for path in seen.empty],
        "view_errors_px": {
            view.name: [float(value) for value in errors]
            for view, errors in zip(fit.views, fit.errors_px, strict=True)
        },
        "coverage_left": _coverage([view.seen[0].pixels for view in fit.views], rig.left),
        "coverage_right": _coverage([view.seen[1].pixels for view in fit.views], rig.right),
        "tilt_max_deg": float(tilts_deg.max()),
        "tilted_ratio": float((tilts_deg >= TILT_DEG).mean()),
        "far_to_near": float(away_m.max() / away_m.min()),
        "depth_error_cm": {
            f"{each.depth_m:g}": {k: to_json(100.0 * getattr(each, f"{k}_m")) for k in _DEPTH_CM}
            for each in spread.depths
        },
        "working_error": {
            "distance_m": spread.working.depth_m,
            "calibration_ratio": to_json(spread.working.calibration_m / spread.working.depth_m),
            "matching_ratio": spread.working.matching_m / spread.working.depth_m,
        },
    }


def shared_pixels(view: View) -> tuple[Float64, Float64]:
    """Return the corners that both cameras saw, in the left and right image: float64 (N, 2)."""
    left, right = view.seen
    _, of_left, of_right = np.intersect1d(left.numbers, right.numbers, return_indices=True)
    return left.pixels[of_left], right.pixels[of_right]


def _coverage(pixels: Sequence[Float64], camera: CameraIntrinsics) -> float:
    """Return the fraction of image cells in which a corner was seen, in [0, 1]."""
    size = np.array([camera.width_px, camera.height_px])
    cells = np.floor((np.concatenate(pixels) + 0.5) / size * _CELLS).astype(int)
    inside = np.clip(cells, 0, np.array(_CELLS) - 1)
    return len(np.unique(inside, axis=0)) / (_CELLS[0] * _CELLS[1])


def _distances_m(fit: StereoFit) -> Float64:
    """Return float64 (V,), distance of the middle of the board from the left camera."""
    middles = [
        (T @ [*view.seen[0].board_m.mean(axis=0), 1.0])[:3]
        for T, view in zip(fit.state.T_rig_board, fit.views, strict=True)
    ]
    return np.asarray(np.linalg.norm(middles, axis=1))


def describe_depths(summary: dict[str, Any]) -> dict[str, str]:
    """Return the depth errors of a summary as text, one line per distance."""
    working = summary["working_error"]
    ratio = working["calibration_ratio"]
    text = "unknown" if ratio is None else f"{100 * ratio:.1f} %"
    lines = {f"depth error at the working distance of {working['distance_m']:.3g} m": text}
    for depth, cm in summary["depth_error_cm"].items():
        known = "no common view"
        if cm["calibration"] is not None:
            known = f"{_short(cm['calibration'])} cm"
            known += f", in the middle {_short(cm['low'])} to {_short(cm['high'])}"
        lines[f"depth error at {depth} m"] = f"{known}; of matching {_short(cm['matching'])} cm"
    return lines


def _short(value: float) -> str:
    """Return two significant digits, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"
