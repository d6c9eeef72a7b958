"""What a calibration is good for, in words: a verdict, findings, and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from recon.core.text import counted
from recon.core.values.board import CalibrationBoard
from recon.rig.calibrate.figures import CalibrationFigures
from recon.sources.image_names import ImagePairs

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
_USUAL_BASELINE_M: Final = (0.01, 2.0)
# What a good set of views has, used to say what another one lacks.
_ENOUGH_VIEWS: Final = 20
_COVERED: Final = 0.8
_TILTED: Final = 0.5
_FAR_TO_NEAR: Final = 2.0
TILT_DEG: Final = 20.0  # a board turned away by this much determines the focal length
_SHARP_PX: Final = 0.5
_UNSURE_FOCAL: Final = 0.01  # half of the interval, relative to the focal length
# Texts of findings; {name} is a figure of the summary, or one that is given with the code.
_TEXTS: Final = {
    "overlap": "both cameras have no common view at {at}",
    "depth": "depth at {at} is expected to be wrong by {wrong} ({percent:.1f} %) because of the "
    f"calibration; up to {100 * _GOOD:.0f} % is good, up to {100 * _USABLE:.0f} % usable",
    "views": f"only {{views}}: the expected error is unsure; take {_ENOUGH_VIEWS}",
    "coverage": "the board was seen in {percent:.0f} % of the {side} image: the lens is guessed "
    "elsewhere; show it in every corner",
    "together": "both cameras together fit worse than alone: not synchronised, or moved?",
    "rows": "the epipolar error is {epipolar_95_px:.2f} px after rectification (95 % of the corners are "
    "better): matching fails there; is the board flat, does --model suit?",
    "baseline": "baseline is {baseline_m:.3g} m: are the squares really {square_mm:g} mm?",
    "square": "size of a square not given: every length is in squares; add it, as in :25mm",
    "order": "names do not say which images belong together: paired by their order",
    "unpaired": "images without a partner, left out: {count} ({names})",
    "board": "board not found in {names}",
    "dropped": "dropped, since they do not fit: {names}",
    "repeats": "{views} with the board where another one has it, counted once; move and tilt it "
    "between two views",
    "corners": "bring the board closer to the corners: seen in {percent:.0f} % of the {side} "
    f"image, {100 * _COVERED:.0f} % is good",
    "tilt": f"tilt the board more: by {TILT_DEG:.0f} degrees or more in "
    "{percent:.0f} % of the views, half of them is good",
    "focal": "focal length is unsure: {low:.1f} to {high:.1f} px; take more tilted views",
    "distances": "hold the board nearer and farther: the farthest view is only {far_to_near:.1f} "
    "times as far as the nearest",
    "sharpness": "corners fit to {stereo_rms_px:.2f} px only: focus, light, a flat board, and hold "
    "it still",
    "more": f"take more views: {{views_used}} different ones, {_ENOUGH_VIEWS} are good",
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
    board: CalibrationBoard, images: ImagePairs, figures: CalibrationFigures
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
    found += described("warning", _doubts(board, figures))
    lacking: list[CalibrationFinding] = []
    if verdict_of_calibration(found) != "good":
        nothing = CalibrationFinding("more", "note", _NOTHING_LACKS)
        lacking = described("note", _lacks(figures)) or [nothing]
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


def _doubts(board: CalibrationBoard, found: CalibrationFigures) -> Found:
    if found.views_used < _FEW_VIEWS:
        yield "views", {"views": counted(found.views_used, "different view")}
    for side, ratio in (("left", found.coverage_left), ("right", found.coverage_right)):
        if ratio < _SMALL_COVERAGE:
            yield "coverage", {"percent": 100 * ratio, "side": side}
    if found.stereo_rms_px > _APART * max(found.left_rms_px, found.right_rms_px):
        yield "together", {}
    if found.epipolar_95_px > _ROWS_PX:
        yield "rows", {}
    shortest, longest = _USUAL_BASELINE_M
    if board.metric and not shortest <= found.baseline_m <= longest:
        yield "baseline", {"square_mm": 1e3 * board.square_m}


def _left_out(board: CalibrationBoard, images: ImagePairs, found: CalibrationFigures) -> Found:
    """Yield what was left out or is not known; none of it makes the depth of this rig worse."""
    if not board.metric:
        yield "square", {}
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
    if _SMALL_COVERAGE <= ratio < _COVERED:
        yield "corners", {"percent": 100 * ratio, "side": side}
    if found.tilted_ratio < _TILTED:
        yield "tilt", {"percent": 100 * found.tilted_ratio}
    low, high = found.focal_interval_px
    if high - low > 2 * _UNSURE_FOCAL * found.focal_px:
        yield "focal", {"low": low, "high": high}
    if found.far_to_near < _FAR_TO_NEAR:
        yield "distances", {}
    if found.stereo_rms_px > _SHARP_PX:
        yield "sharpness", {}
    if _FEW_VIEWS <= found.views_used < _ENOUGH_VIEWS:
        yield "more", {}


def _length(metres: float, board: CalibrationBoard) -> str:
    if not board.metric:
        return f"{metres:.3g} squares"
    return f"{100 * metres:.2g} cm" if metres < 0.995 else f"{metres:.3g} m"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
