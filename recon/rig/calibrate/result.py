"""The result of a calibration: the rig with what was measured of it, and its files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.summary import Rows, RunSummary, inline, optional, shown_path
from recon.core.text import counted, metres
from recon.core.values import CameraIntrinsics
from recon.core.values.arrays import Float64
from recon.rig.calibrate.board_views import BoardViews
from recon.rig.calibrate.bootstrap import Spread
from recon.rig.calibrate.bundle import View
from recon.rig.calibrate.figures import CalibrationFigures, DepthErrorCm, WorkingError
from recon.rig.calibrate.stereo import StereoFit
from recon.rig.calibrate.verdict import (
    TILT_DEG,
    CalibrationFinding,
    Verdict,
    judge_calibration,
    verdict_of_calibration,
)
from recon.rig.settings import CalibratedSettings
from recon.rig.written import CalibrationForm, write_rig
from recon.sources.image_names import ImagePairs
from recon.stereo.rectify.rectifier import RectifyingTurns, plan_turns

_CELLS: Final = (8, 6)  # image cells; without corners in one, the lens is extrapolated there
# Figures that are also written into the calibration file.
_KEPT: Final = (
    "verdict", "board", "stereo_rms_px", "epipolar_px", "baseline_interval_m", "focal_interval_px",
    "views_used", "views_dropped", "depth_error_cm",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CalibrationSummary(RunSummary):
    """What `recon calibrate` found; its warnings are the texts of its findings."""

    figures: CalibrationFigures = inline()
    model: str  # of the lenses
    verdict: Verdict
    findings: Sequence[CalibrationFinding]
    frames_left_out: int  # images without a partner
    files: Sequence[str] | None = optional()  # where else the calibration was written

    def remarks(self) -> list[tuple[str, str]]:
        return [(finding.severity, finding.text) for finding in self.findings]

    def rows(self) -> Rows:
        found, out = self.figures, self.out or ""
        low_m, high_m = found.baseline_interval_m
        low_px, high_px = found.focal_interval_px
        baseline = f"{found.baseline_m:.4g} m ({low_m:.4g} to {high_m:.4g})"
        focal = f"{found.focal_px:.1f} px ({low_px:.1f} to {high_px:.1f})"
        views = f"{found.views_used} of {counted(found.views, 'view')}"
        working = found.working_error
        ratio, at = working.calibration_ratio, metres(working.distance_m)
        off = "no common view" if ratio is None else f"error of {100 * ratio:.1f} %"
        file = (self.files or [str(Path(out, "calibration.yaml"))])[0]
        again = "take other views as said above, and calibrate again"
        use = f"recon audit DRIVE --calib {shown_path(file)}"
        return [
            (f"calibration of {views}, lens {self.model}: {self.verdict}",),
            ("file", ", ".join(self.files or [file])),
            ("report", str(Path(out, "report.html"))),
            ("fit", f"{found.stereo_rms_px:.2f} px, epipolar error {found.epipolar_px:.2f} px"),
            ("rig", f"baseline {baseline}, focal {focal}"),
            ("depth", f"{off} at {at} expected of the calibration"),
            *self.cost_row(),
            ("next", again if self.verdict == "repeat" else use),
        ]


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The results of a run."""

    config: CalibratedSettings
    seen: BoardViews
    fit: StereoFit
    spread: Spread
    turns: RectifyingTurns
    epipolar_error_px: Float64  # (N,), epipolar errors of all corners after rectification
    summary: CalibrationSummary


def describe_calibration(
    seen: BoardViews,
    fit: StereoFit,
    spread: Spread,
    config: CalibratedSettings,
    images: ImagePairs,
) -> CalibrationResult:
    """Rectify the views with the calibrated rig, measure how well it describes them, and judge."""
    turns = plan_turns(fit.calibration, config.rectification)
    rows = []
    for left_px, right_px in map(shared_pixels, fit.views):
        left = turns.place(fit.calibration, left_px)
        rows.append(left[:, 1] - turns.place(fit.calibration, right_px, right=True)[:, 1])
    epipolar_error_px = np.concatenate(rows)
    figures = _figures(seen, fit, spread, epipolar_error_px, turns.camera.focal_px)
    findings = judge_calibration(seen.board, images, figures)
    summary = CalibrationSummary(
        figures=figures,
        model=config.calibration.model,
        verdict=verdict_of_calibration(findings),
        findings=findings,
        frames_left_out=len(images.lonely),
        warnings=[finding.text for finding in findings],
    )
    return CalibrationResult(config, seen, fit, spread, turns, epipolar_error_px, summary)


def write_calibration(
    path: Path, run: CalibrationResult, form: CalibrationForm | None = None
) -> tuple[Path, ...]:
    """Write the calibrated rig; see `write_rig`."""
    found = run.summary.to_json()
    quality = {key: found[key] for key in _KEPT}
    return write_rig(path, run.fit.calibration, run.config.rectification, form, quality)


def _figures(
    seen: BoardViews,
    fit: StereoFit,
    spread: Spread,
    epipolar_error_px: Float64,
    rectified_focal_px: float,
) -> CalibrationFigures:
    rig, away_m, away = fit.calibration, _distances_m(fit), spread.working
    # Angles between the board's normal and the optical axis of the left camera.
    tilts_deg = np.degrees(np.arccos(np.clip(np.abs(fit.state.T_rig_board[:, 2, 2]), 0.0, 1.0)))
    return CalibrationFigures(
        board=str(seen.board),
        width_px=seen.size_px[0],
        height_px=seen.size_px[1],
        stereo_rms_px=fit.rms_px,
        left_rms_px=fit.alone_px[0],
        right_rms_px=fit.alone_px[1],
        epipolar_px=float(np.abs(epipolar_error_px).mean()),
        epipolar_95_px=float(np.quantile(np.abs(epipolar_error_px), 0.95)),
        baseline_m=rig.baseline_m,
        baseline_interval_m=list(spread.baseline_m),
        baseline_squares=rig.baseline_m / seen.board.square_m,
        focal_px=float(rig.left.matrix[0, 0]),
        focal_interval_px=list(spread.focal_px),
        focal_right_px=float(rig.right.matrix[0, 0]),
        rotation_spread_deg=spread.rotation_deg,
        views=seen.count,
        views_used=len(fit.views),
        views_repeated=list(fit.repeated),
        views_dropped=list(fit.dropped),
        dropped_error_px=fit.dropped,
        pictures_without_board=[path.name for path in seen.empty],
        view_errors_px={
            view.name: [float(value) for value in errors]
            for view, errors in zip(fit.views, fit.errors_px, strict=True)
        },
        coverage_left=_coverage([view.seen[0].pixels for view in fit.views], rig.left),
        coverage_right=_coverage([view.seen[1].pixels for view in fit.views], rig.right),
        tilt_max_deg=float(tilts_deg.max()),
        tilted_ratio=float((tilts_deg >= TILT_DEG).mean()),
        far_to_near=float(away_m.max() / away_m.min()),
        depth_error_cm={
            f"{each.depth_m:g}": DepthErrorCm(
                _known(100.0 * each.calibration_m),
                _known(100.0 * each.low_m),
                _known(100.0 * each.high_m),
                100.0 * each.matching_m,
            )
            for each in spread.depths
        },
        working_error=WorkingError(
            away.depth_m,
            _known(away.calibration_m / away.depth_m),
            away.matching_m / away.depth_m,
        ),
        rectified_focal_px=rectified_focal_px,
    )


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


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
