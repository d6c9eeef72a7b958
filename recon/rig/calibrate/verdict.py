"""The result of a calibration: its figures and files, and what it is good for, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np

from recon.core.summary import Rows, RunSummary, inline, optional, shown_path
from recon.core.text import counted, metres
from recon.core.values.arrays import Float64
from recon.core.values.board import CalibrationBoard
from recon.look.settings import AuditSettings
from recon.rig.calibrate.board_views import BoardViews
from recon.rig.calibrate.bundle import View
from recon.rig.calibrate.figures import CalibrationFigures, DepthErrorCm, WorkingError
from recon.rig.calibrate.lenses import LensChoice
from recon.rig.calibrate.stereo import Spread, StereoFit, distances_m, seen_cells
from recon.rig.settings import CalibratedSettings
from recon.rig.written import CalibrationForm, write_rig
from recon.sources.images import ImagePairs
from recon.stereo.rectify.rectifier import RectifyingTurns, plan_turns

Verdict = Literal["good", "usable", "repeat"]
Severity = Literal["fatal", "warning", "note"]
Found = Iterator[tuple[str, dict[str, Any]]]  # codes, and figures for their texts
# Depth error due to calibration at the working distance, relative to it. 2 % is what the makers of
# depth cameras promise for their near range, and 5 % for the far one.
_GOOD: Final = 0.02
_USABLE: Final = 0.05
# The forecast is itself a guess from fewer views, or where the lens was hardly seen.
_FEW_VIEWS: Final = 10
_SMALL_COVERAGE: Final = 0.5
_APART: Final = 2.0  # stereo error relative to that of each camera alone
_ROWS_PX: Final = 1.0  # a block matcher loses most matches to a epipolar error of one pixel
# What a good set of views has, used to say what another one lacks.
ENOUGH_VIEWS: Final = 20
COVERED: Final = 0.8
TILTED: Final = 0.5
FAR_TO_NEAR: Final = 2.0
TILT_DEG: Final = 20.0  # a board turned away by this much determines the focal length
_SHARP_PX: Final = 0.5
_UNSURE_FOCAL: Final = 0.01  # half of the interval, relative to the focal length
# Texts of findings; {name} is a figure of the summary, or one that is given with the code.
_TEXTS: Final = {
    "overlap": "both cameras have no common view at {at}",
    "depth": "depth at {at} is expected to be wrong by {wrong} ({percent:.1f} %) because of the "
    f"calibration; up to {100 * _GOOD:.0f} % is good, up to {100 * _USABLE:.0f} % usable",
    "views": f"only {{views}}: the expected error is unsure; take {ENOUGH_VIEWS}",
    "coverage": "the board was seen in {percent:.0f} % of the {side} image: the lens is guessed "
    "elsewhere; show it in every corner",
    "together": "both cameras together fit worse than alone: not synchronised, or moved?",
    "rows": "the epipolar error is {epipolar_95_px:.2f} px after rectification (95 % of the "
    "corners are better): matching fails there; is the board flat, does --model suit?",
    "baseline": "baseline is {baseline_m:.3g} m: are the {said} really {given_mm:g} mm?",
    "square": "size of a square not given: every length is in squares; add it, as in :25mm",
    "order": "names do not say which images belong together: paired by their order",
    "unpaired": "images without a partner, left out: {count} ({names})",
    "board": "board not found in {names}",
    "dropped": "dropped, since they do not fit: {names}",
    "repeats": "{views} with the board where another one has it, counted once; move and tilt it "
    "between two views",
    "corners": "bring the board closer to the corners: seen in {percent:.0f} % of the {side} "
    f"image, {100 * COVERED:.0f} % is good",
    "tilt": f"tilt the board more: by {TILT_DEG:.0f} degrees or more in "
    "{percent:.0f} % of the views, half of them is good",
    "focal": "focal length is unsure: {low:.1f} to {high:.1f} px; take more tilted views",
    "distances": "hold the board nearer and farther: the farthest view is only {far_to_near:.1f} "
    "times as far as the nearest",
    "sharpness": "corners fit to {stereo_rms_px:.2f} px only: focus, light, a flat board, and hold "
    "it still",
    "model": "{best} fits the lens better: {lens.held_out_px:.2f} px in views that are left out, "
    "against {own.held_out_px:.2f}{fewer}; --model {best}",
    "lens": "no lens model fits views that are held out: {errors}; is the board flat and the image "
    "sharp?",
    "more": f"take more views: {{views_used}} different ones, {ENOUGH_VIEWS} are good",
}
_NOTHING_LACKS: Final = "the views lack nothing: take more of their kind"


@dataclass(frozen=True)
class CalibrationFinding:
    """One fact about a calibration that its user should know."""

    code: str  # its kind, one word, for programs
    severity: Severity  # see `verdict_of_calibration`; a note does not change the verdict
    text: str  # description and advice, for people


def verdict_of_calibration(findings: Sequence[CalibrationFinding]) -> Verdict:
    """Return repeat with a fatal finding, usable with a warning, else good."""
    found = {finding.severity for finding in findings}
    if "fatal" in found:
        return "repeat"
    return "usable" if "warning" in found else "good"


def judge_calibration(
    board: CalibrationBoard,
    images: ImagePairs,
    figures: CalibrationFigures,
    lens: Sequence[tuple[str, dict[str, Any]]] = (),
) -> list[CalibrationFinding]:
    """Return all findings of a calibration, the gravest first."""
    known = figures.to_json()

    def described(severity: Severity, found: Found) -> list[CalibrationFinding]:
        return [
            CalibrationFinding(code, severity, _TEXTS[code].format_map(known | own))
            for code, own in found
        ]

    ratio = figures.working_error.calibration_ratio
    found = described(
        "fatal" if ratio is None or ratio > _USABLE else "warning", _depth_faults(board, figures)
    )
    found += described("warning", _doubts(figures))
    lacking = described("note", iter(lens))
    if verdict_of_calibration(found) != "good":
        nothing = CalibrationFinding("more", "note", _NOTHING_LACKS)
        lacking = [*lacking, *described("note", _lacks(figures))] or [nothing]
    return [*found, *described("note", _left_out(board, images, figures)), *lacking]


def _depth_faults(board: CalibrationBoard, found: CalibrationFigures) -> Found:
    expected = found.working_error
    distance_m, ratio = expected.distance_m, expected.calibration_ratio
    at = _length(distance_m, board)
    if ratio is None:
        yield "overlap", {"at": at}
    elif ratio > _GOOD:
        wrong = _length(ratio * distance_m, board)
        yield "depth", {"at": at, "wrong": wrong, "percent": 100 * ratio}


def _doubts(found: CalibrationFigures) -> Found:
    if found.views_used < _FEW_VIEWS:
        yield "views", {"views": counted(found.views_used, "different view")}
    for side, ratio in (("left", found.coverage_left), ("right", found.coverage_right)):
        if ratio < _SMALL_COVERAGE:
            yield "coverage", {"percent": 100 * ratio, "side": side}
    if found.stereo_rms_px > _APART * max(found.left_rms_px, found.right_rms_px):
        yield "together", {}
    if found.epipolar_95_px > _ROWS_PX:
        yield "rows", {}


def _left_out(board: CalibrationBoard, images: ImagePairs, found: CalibrationFigures) -> Found:
    """Yield what was left out or is not known; none of it makes the depth of this rig worse."""
    shortest, longest = AuditSettings().baseline_m
    if not board.metric:
        yield "square", {}
    elif not shortest <= found.baseline_m <= longest:
        said, given_m = board.measured
        yield "baseline", {"said": said, "given_mm": 1e3 * given_m}
    if images.by_order:
        yield "order", {}
    if images.lonely:
        names = _listed([path.name for path in images.lonely])
        yield "unpaired", {"count": len(images.lonely), "names": names}
    if found.pictures_without_board:
        yield "board", {"names": _listed(found.pictures_without_board)}
    if found.views_dropped:
        yield "dropped", {"names": _listed(found.views_dropped)}
    if found.views_repeated:
        yield "repeats", {"views": counted(len(found.views_repeated), "view")}


def _lacks(found: CalibrationFigures) -> Found:
    ratio, side = min((found.coverage_left, "left"), (found.coverage_right, "right"))
    if _SMALL_COVERAGE <= ratio < COVERED:
        yield "corners", {"percent": 100 * ratio, "side": side}
    if found.tilted_ratio < TILTED:
        yield "tilt", {"percent": 100 * found.tilted_ratio}
    low, high = found.focal_interval_px
    if high - low > 2 * _UNSURE_FOCAL * found.focal_px:
        yield "focal", {"low": low, "high": high}
    if found.far_to_near < FAR_TO_NEAR:
        yield "distances", {}
    if found.stereo_rms_px > _SHARP_PX:
        yield "sharpness", {}
    if _FEW_VIEWS <= found.views_used < ENOUGH_VIEWS:
        yield "more", {}


def lens_faults(lenses: Mapping[str, LensChoice], model: str) -> Found:
    """Yield a model that suits the lens better, or that none does."""
    own, suiting = lenses.get(model), [name for name, lens in lenses.items() if lens.suits]
    best = min(suiting, key=lambda name: lenses[name].working_ratio, default=model)
    if own is not None and best != model and (not own.suits or own.working_ratio > _GOOD):
        fewer = own.coefficients - lenses[best].coefficients
        text = f", with {fewer} fewer coefficients" if fewer > 0 else ""
        yield "model", {"best": best, "lens": lenses[best], "own": own, "fewer": text}
    if lenses and min(lens.held_out_px for lens in lenses.values()) > _SHARP_PX:
        errors = ", ".join(f"{name} {lens.held_out_px:.2f} px" for name, lens in lenses.items())
        yield "lens", {"errors": errors}


def _length(metres: float, board: CalibrationBoard) -> str:
    if not board.metric:
        return f"{metres:.3g} squares"
    return f"{100 * metres:.2g} cm" if metres < 0.995 else f"{metres:.3g} m"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


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
    lenses: Mapping[str, LensChoice] = MappingProxyType({}),
) -> CalibrationResult:
    """Rectify the views with the calibrated rig, measure how well it describes them, and judge."""
    turns = plan_turns(fit.calibration, config.rectification)
    rows = []
    for left_px, right_px in map(shared_pixels, fit.views):
        left = turns.place(fit.calibration, left_px)
        rows.append(left[:, 1] - turns.place(fit.calibration, right_px, right=True)[:, 1])
    epipolar_error_px = np.concatenate(rows)
    figures = replace(
        _figures(seen, fit, spread, epipolar_error_px, turns.camera.focal_px),
        held_out_px={name: lens.held_out_px for name, lens in lenses.items()},
    )
    lens = list(lens_faults(lenses, config.calibration.model))
    findings = judge_calibration(seen.board, images, figures, lens)
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
    rig, away_m, away = fit.calibration, distances_m(fit), spread.working
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
        coverage_left=float(seen_cells(fit, 0).mean()),
        coverage_right=float(seen_cells(fit, 1).mean()),
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
            away.depth_m, _known(away.calibration_m / away.depth_m), away.matching_m / away.depth_m
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
