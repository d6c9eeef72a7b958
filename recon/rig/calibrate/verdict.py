"""What a calibration is good for, in words: a verdict, findings, and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from recon.core.text import counted
from recon.core.values.board import CalibrationBoard
from recon.sources.image_names import ImagePairs

Verdict = Literal["good", "usable", "repeat"]
Severity = Literal["fatal", "warning", "note"]

# Depth error due to calibration at the working distance, relative to it. 2 % is what the makers of
# depth cameras promise for their near range, and 5 % for the far one.
_GOOD: Final = 0.02
_USABLE: Final = 0.05
# The forecast is itself a guess from fewer views, or where the lens was hardly seen.
_FEW_VIEWS: Final = 10
_SMALL_COVERAGE: Final = 0.5
_APART: Final = 2.0  # stereo error relative to that of each camera alone
_ROWS_PX: Final = 1.0  # a block matcher loses most matches to a row error of one pixel
_USUAL_BASELINE_M: Final = (0.01, 2.0)
# What a good set of views has, used to say what another one lacks.
_ENOUGH_VIEWS: Final = 20
_COVERED: Final = 0.8
_TILTED: Final = 0.5
_FAR_TO_NEAR: Final = 2.0
TILT_DEG: Final = 20.0
"""A board turned away from the camera by this much determines the focal length."""
_SHARP_PX: Final = 0.5
_UNSURE_FOCAL: Final = 0.01  # half of the interval, relative to the focal length


@dataclass(frozen=True)
class CalibrationFinding:
    """One fact about a calibration that its user should know.

    Attributes:
        code: Its kind, one word, for programs.
        severity: ``fatal`` makes the verdict "repeat", ``warning`` makes it "usable" at best, and
            a ``note`` does not change it.
        text: Description and advice, for people.
    """

    code: str
    severity: Severity
    text: str


def verdict_of_calibration(findings: Sequence[CalibrationFinding]) -> Verdict:
    """Return repeat with a fatal finding, usable with a warning, else good."""
    found = {finding.severity for finding in findings}
    if "fatal" in found:
        return "repeat"
    return "usable" if "warning" in found else "good"


def judge_calibration(
    board: CalibrationBoard, images: ImagePairs, summary: dict[str, Any]
) -> list[CalibrationFinding]:
    """Return all findings of a calibration, the gravest first."""
    found = [
        *_find_depth_faults(board, summary),
        *_find_fit_faults(board, summary),
        *_find_left_out(board, images, summary),
    ]
    if verdict_of_calibration(found) != "good":
        found += list(_advise(summary)) or [
            CalibrationFinding("more", "note", "the views lack nothing: take more of their kind")
        ]
    order = ("fatal", "warning", "note")
    return sorted(found, key=lambda finding: order.index(finding.severity))


def _find_depth_faults(
    board: CalibrationBoard, summary: dict[str, Any]
) -> Iterator[CalibrationFinding]:
    """Yield what the calibration does to depth at the working distance."""
    expected = summary["working_error"]
    at = f"at {_length(expected['distance_m'], board)}"
    share = expected["calibration_share"]
    if share is None:
        yield CalibrationFinding("overlap", "fatal", f"both cameras have no common view {at}")
    elif share > _GOOD:
        severity: Severity = "fatal" if share > _USABLE else "warning"
        wrong = _length(share * expected["distance_m"], board)
        yield CalibrationFinding(
            "depth",
            severity,
            f"depth {at} is expected to be wrong by {wrong} ({100 * share:.1f} %) because of the "
            f"calibration; up to {100 * _GOOD:.0f} % is good, up to {100 * _USABLE:.0f} % usable",
        )


def _find_fit_faults(
    board: CalibrationBoard, summary: dict[str, Any]
) -> Iterator[CalibrationFinding]:
    """Yield reasons for which depth may be worse than expected."""
    used = summary["views_used"]
    if used < _FEW_VIEWS:
        views = counted(used, "different view")
        text = f"only {views}: the expected error is unsure; take {_ENOUGH_VIEWS}"
        yield CalibrationFinding("views", "warning", text)
    for side in ("left", "right"):
        share = summary[f"coverage_{side}"]
        if share < _SMALL_COVERAGE:
            yield CalibrationFinding(
                "coverage",
                "warning",
                f"the board was seen in {100 * share:.0f} % of the {side} image: "
                "the lens is guessed elsewhere; show it in every corner",
            )
    if summary["stereo_rms_px"] > _APART * max(summary["left_rms_px"], summary["right_rms_px"]):
        text = "both cameras together fit worse than alone: not synchronised, or moved?"
        yield CalibrationFinding("together", "warning", text)
    if summary["epipolar_95_px"] > _ROWS_PX:
        text = (
            f"rows are {summary['epipolar_95_px']:.2f} px apart after rectification (95 % of the "
            "corners are better): matching fails there; is the board flat, does --model suit?"
        )
        yield CalibrationFinding("rows", "warning", text)
    shortest, longest = _USUAL_BASELINE_M
    if board.metric and not shortest <= summary["baseline_m"] <= longest:
        text = (
            f"baseline is {summary['baseline_m']:.3g} m: are the squares really "
            f"{1e3 * board.square_m:g} mm?"
        )
        yield CalibrationFinding("baseline", "warning", text)


def _find_left_out(
    board: CalibrationBoard, images: ImagePairs, summary: dict[str, Any]
) -> Iterator[CalibrationFinding]:
    """Yield what was left out or is not known; none of it makes the depth of this rig worse."""
    if not board.metric:
        text = "size of a square not given: every length is in squares; add it, as in :25mm"
        yield CalibrationFinding("square", "note", text)
    if images.by_order:
        text = "names do not say which images belong together: paired by their order"
        yield CalibrationFinding("order", "note", text)
    if images.lonely:
        names = _listed([path.name for path in images.lonely])
        text = f"images without a partner, left out: {len(images.lonely)} ({names})"
        yield CalibrationFinding("unpaired", "note", text)
    if summary["pictures_without_board"]:
        text = f"board not found in {_listed(summary['pictures_without_board'])}"
        yield CalibrationFinding("board", "note", text)
    if summary["views_dropped"]:
        text = f"dropped, since they do not fit: {_listed(summary['views_dropped'])}"
        yield CalibrationFinding("dropped", "note", text)
    if summary["views_repeated"]:
        views = counted(len(summary["views_repeated"]), "view")
        again = "with the board where another one has it, counted once"
        text = f"{views} {again}; move and tilt it between two views"
        yield CalibrationFinding("repeats", "note", text)


def _advise(summary: dict[str, Any]) -> Iterator[CalibrationFinding]:
    """Yield what the views lack for a better calibration."""
    side, share = min((summary[f"coverage_{side}"], side) for side in ("left", "right"))[::-1]
    if _SMALL_COVERAGE <= share < _COVERED:
        yield CalibrationFinding(
            "corners",
            "note",
            f"bring the board closer to the corners: seen in {100 * share:.0f} % of the {side} "
            f"image, {100 * _COVERED:.0f} % is good",
        )
    if summary["tilted_share"] < _TILTED:
        yield CalibrationFinding(
            "tilt",
            "note",
            f"tilt the board more: by {TILT_DEG:.0f} degrees or more in "
            f"{100 * summary['tilted_share']:.0f} % of the views, half of them is good",
        )
    low, high = summary["focal_interval_px"]
    if high - low > 2 * _UNSURE_FOCAL * summary["focal_px"]:
        text = f"focal length is unsure: {low:.1f} to {high:.1f} px; take more tilted views"
        yield CalibrationFinding("focal", "note", text)
    if summary["far_to_near"] < _FAR_TO_NEAR:
        yield CalibrationFinding(
            "distances",
            "note",
            "hold the board nearer and farther: the farthest view is only "
            f"{summary['far_to_near']:.1f} times as far as the nearest",
        )
    if summary["stereo_rms_px"] > _SHARP_PX:
        yield CalibrationFinding(
            "sharpness",
            "note",
            f"corners fit to {summary['stereo_rms_px']:.2f} px only: focus, light, a flat board, "
            "and hold it still",
        )
    if _FEW_VIEWS <= summary["views_used"] < _ENOUGH_VIEWS:
        text = f"take more views: {summary['views_used']} different ones, {_ENOUGH_VIEWS} are good"
        yield CalibrationFinding("more", "note", text)


def _length(metres: float, board: CalibrationBoard) -> str:
    if not board.metric:
        return f"{metres:.3g} squares"
    return f"{100 * metres:.2g} cm" if metres < 0.995 else f"{metres:.3g} m"


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
