"""The figures of a calibration, and advice on improving it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from recon.calibration import DepthError, Spread, StereoFit, coverage, tilt_deg
from recon.pipeline.board_views import BoardViews
from recon.pipeline.summary import plain
from recon.sources.picture_pairs import PicturePairs
from recon.structures.arrays import Float64
from recon.structures.board import CalibrationBoard

_FEW_VIEWS: Final = 10
_SMALL_COVERAGE: Final = 0.5
_SMALL_TILT_DEG: Final = 15.0
_UNSURE_FOCAL: Final = 0.01  # half of the interval, relative to the focal length
_USUAL_BASELINE_M: Final = (0.01, 2.0)
_APART: Final = 2.0  # stereo error relative to that of each camera alone


def summarise(seen: BoardViews, fit: StereoFit, spread: Spread, rows_px: Float64) -> dict[str, Any]:
    """The figures of ``summary.json``, without time and memory of the run."""
    rig = fit.calibration
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
        "views_dropped": list(fit.dropped),
        "dropped_error_px": fit.dropped,
        "pictures_without_board": [path.name for path in seen.empty],
        "view_errors_px": {
            view.name: [float(value) for value in errors]
            for view, errors in zip(fit.views, fit.errors_px, strict=True)
        },
        "coverage_left": coverage([view.seen[0].pixels for view in fit.views], rig.left),
        "coverage_right": coverage([view.seen[1].pixels for view in fit.views], rig.right),
        "tilt_max_deg": float(tilt_deg(fit).max()),
        "depth_error_cm": {f"{each.depth_m:g}": _depth_cm(each) for each in spread.depths},
    }


def advise(board: CalibrationBoard, pictures: PicturePairs, summary: dict[str, Any]) -> list[str]:
    """Weaknesses of the calibration, each with advice, one line each."""
    lines = []
    if not board.metric:
        lines.append("size of a square not given: every length is in squares; add it, as in :25mm")
    if pictures.by_order:
        lines.append("names do not tell which pictures belong together: paired by their order")
    if summary["pictures_without_board"]:
        lines.append(f"board not found in {_listed(summary['pictures_without_board'])}")
    if summary["views_dropped"]:
        lines.append(f"dropped, since they do not fit: {_listed(summary['views_dropped'])}")
    if summary["views_used"] < _FEW_VIEWS:
        lines.append(f"only {summary['views_used']} views: take {_FEW_VIEWS} or more")
    for side in ("left", "right"):
        share = summary[f"coverage_{side}"]
        if share < _SMALL_COVERAGE:
            lines.append(
                f"the board was seen in {100 * share:.0f} % of the {side} picture: "
                "the lens is guessed elsewhere; show it in every corner"
            )
    if summary["tilt_max_deg"] < _SMALL_TILT_DEG:
        lines.append("the board always faced the camera: tilt it, or the focal length is a guess")
    low, high = summary["focal_interval_px"]
    if high - low > 2 * _UNSURE_FOCAL * summary["focal_px"]:
        lines.append(f"focal length is unsure: {low:.1f} to {high:.1f} px; take more tilted views")
    shortest, longest = _USUAL_BASELINE_M
    if board.metric and not shortest <= summary["baseline_m"] <= longest:
        lines.append(
            f"baseline is {summary['baseline_m']:.3g} m: are the squares really "
            f"{1e3 * board.square_m:g} mm?"
        )
    alone = max(summary["left_rms_px"], summary["right_rms_px"])
    if summary["stereo_rms_px"] > _APART * alone:
        lines.append("both cameras together fit worse than alone: not synchronised, or moved?")
    return lines


def tell_depths(summary: dict[str, Any]) -> dict[str, str]:
    """The depth errors of a summary as text, one line per distance."""
    lines = {}
    for depth, cm in summary["depth_error_cm"].items():
        known = "no common view"
        if cm["calibration"] is not None:
            known = f"{_short(cm['calibration'])} cm"
            known += f", in the middle {_short(cm['low'])} to {_short(cm['high'])}"
        lines[f"depth error at {depth} m"] = f"{known}; of matching {_short(cm['matching'])} cm"
    return lines


def _short(value: float) -> str:
    """Two significant digits, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def _depth_cm(each: DepthError) -> dict[str, float | None]:
    metres = {
        "calibration": each.calibration_m,
        "low": each.low_m,
        "high": each.high_m,
        "matching": each.matching_m,
    }
    return {name: plain(100.0 * value) for name, value in metres.items()}


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
