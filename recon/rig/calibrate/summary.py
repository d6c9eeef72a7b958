"""The figures of a calibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.core.values.arrays import Float64
from recon.rig.calibrate.board_views import BoardViews
from recon.rig.calibrate.bootstrap import DepthError, Spread
from recon.rig.calibrate.quality import coverage, distances_m, tilt_deg
from recon.rig.calibrate.stereo import StereoFit
from recon.rig.calibrate.verdict import TILT_DEG
from recon.run.summary import plain


def summarise(seen: BoardViews, fit: StereoFit, spread: Spread, rows_px: Float64) -> dict[str, Any]:
    """Return the figures of ``summary.json``, without time and memory of the run."""
    rig, tilts_deg, away_m = fit.calibration, tilt_deg(fit), distances_m(fit)
    return {
        "board": str(seen.board),
        "model": rig.left.model,
        "width_px": seen.size_px[0],
        "height_px": seen.size_px[1],
        "stereo_rms_px": fit.rms_px,
        "left_rms_px": fit.alone_px[0],
        "right_rms_px": fit.alone_px[1],
        "epipolar_px": float(np.abs(rows_px).mean()),
        "epipolar_95_px": float(np.quantile(np.abs(rows_px), 0.95)),
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
        "coverage_left": coverage([view.seen[0].pixels for view in fit.views], rig.left),
        "coverage_right": coverage([view.seen[1].pixels for view in fit.views], rig.right),
        "tilt_max_deg": float(tilts_deg.max()),
        "tilted_share": float((tilts_deg >= TILT_DEG).mean()),
        "far_to_near": float(away_m.max() / away_m.min()),
        "depth_error_cm": {f"{each.depth_m:g}": _depth_cm(each) for each in spread.depths},
        "working_error": {
            "distance_m": spread.working.depth_m,
            "calibration_share": plain(spread.working.calibration_m / spread.working.depth_m),
            "matching_share": spread.working.matching_m / spread.working.depth_m,
        },
    }


def tell_depths(summary: dict[str, Any]) -> dict[str, str]:
    """Return the depth errors of a summary as text, one line per distance."""
    working = summary["working_error"]
    share = working["calibration_share"]
    text = "unknown" if share is None else f"{100 * share:.1f} %"
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


def _depth_cm(each: DepthError) -> dict[str, float | None]:
    metres = {
        "calibration": each.calibration_m,
        "low": each.low_m,
        "high": each.high_m,
        "matching": each.matching_m,
    }
    return {name: plain(100.0 * value) for name, value in metres.items()}
