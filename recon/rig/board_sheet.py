"""A calibration board as a printable sheet, to scale: PDF or PNG."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline

from recon.core.errors import OutputError, SettingsError
from recon.core.summary import Rows, Summary, optional
from recon.core.values.arrays import Float64
from recon.core.values.board import CalibrationBoard
from recon.io.atomic import write_bytes
from recon.rig.calibrate.patterns import dark_polygons

_PAPERS_MM: Final = {
    "a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0), "letter": (215.9, 279.4), "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}  # fmt: skip
_AUTO: Final = ("a4", "a3", "a2", "a1", "a0")
_CUSTOM: Final = re.compile(
    r"(\d+(?:\.\d*)?)\s*[x×]\s*(\d+(?:\.\d*)?)\s*mm", re.IGNORECASE | re.ASCII
)
_KINDS: Final = (".pdf", ".png")
_MM_PER_IN: Final = 25.4
_POINT_MM: Final = _MM_PER_IN / 72
# Detectors need a white border around the pattern, and printers leave a few millimetres blank.
_MARGIN_SQUARES: Final = 0.4
_SMALLEST_MARGIN_MM: Final = 10.0
_RULER_MM: Final = 100.0
_LARGEST_PNG_PX: Final = 40_000
_FAINT: Final = "#6e7781"


@dataclass(frozen=True)
class Sheet:
    """Paper with its name, oriented so that a board fits."""

    name: str
    width_mm: float
    height_mm: float


@dataclass(frozen=True, kw_only=True)
class BoardSummary(Summary):
    """A board that was drawn on a sheet."""

    board: str
    square_mm: float  # or the step between tags, or circles
    measured: str  # what to measure on the print
    pattern_width_mm: float
    pattern_height_mm: float
    paper: str
    paper_width_mm: float
    paper_height_mm: float
    file: str
    dpi: float | None = optional()  # of a PNG

    def rows(self) -> Rows:
        size = f"{self.pattern_width_mm:g} × {self.pattern_height_mm:g} mm"
        sheet = f"{self.paper_width_mm:g} × {self.paper_height_mm:g} mm"
        dpi = "" if self.dpi is None else f", {self.dpi:.1f} dpi"
        return [
            (f"board {self.board}, {size}, {self.measured}",),
            ("file", self.file, f"{self.paper}, {sheet}{dpi}"),
            ("print", "at 100 %, and check the ruler on it"),
            ("next", f"recon calibrate LEFT RIGHT --board {self.board}"),
        ]


def write_board(
    path: Path, board: CalibrationBoard, paper: str | None = None, dpi: float = 300.0
) -> BoardSummary:
    """Draw a board to scale in the centre of a sheet, with a ruler to check the print.

    ``paper`` is the name of a size, or ``600x400mm``; None = the smallest A size that fits. ``dpi``
    is approximate, as squares of a PNG have whole pixels. Returns a description of the sheet.
    """
    kind = path.suffix.lower()
    if kind not in _KINDS:
        raise OutputError(
            "a board is printed from PDF or PNG",
            where=path,
            got=kind or "no suffix",
            expected=" or ".join(_KINDS),
        )
    if not board.metric:
        raise SettingsError(
            "a board to print needs the size of its squares",
            got=str(board),
            hint="name it, as in chess:9x6:25mm",
        )
    sheet = choose_sheet(board, paper)
    square_in = 1e3 * board.square_m / _MM_PER_IN
    exact_dpi = max(round(square_in * dpi), 1) / square_in
    longest = round(max(sheet.width_mm, sheet.height_mm) / _MM_PER_IN * exact_dpi)
    if kind == ".png" and longest > _LARGEST_PNG_PX:
        raise SettingsError(
            "image of the board would be too large",
            got=f"{longest} px",
            expected=f"at most {_LARGEST_PNG_PX} px",
            hint="a smaller --dpi, or PDF, which has none",
        )
    write_bytes(path, _draw(board, sheet, kind[1:], exact_dpi))
    width_mm, height_mm = (1e3 * length for length in board.size_m)
    return BoardSummary(
        board=str(board),
        square_mm=1e3 * board.square_m,
        measured=f"{board.measured[0]} of {1e3 * board.measured[1]:g} mm",
        pattern_width_mm=width_mm,
        pattern_height_mm=height_mm,
        paper=sheet.name,
        paper_width_mm=sheet.width_mm,
        paper_height_mm=sheet.height_mm,
        file=str(path),
        dpi=exact_dpi if kind == ".png" else None,
    )


def choose_sheet(board: CalibrationBoard, paper: str | None = None) -> Sheet:
    """Return the paper for a board, in portrait or landscape orientation."""
    names = _AUTO if paper is None else (paper.strip().lower(),)
    sheets = [_turned(name, board) for name in names]
    fitting = [sheet for sheet in sheets if _scale_to_fit(board, sheet) >= 1]
    if fitting:
        return fitting[0]
    said, given_m = board.measured
    largest_mm = 1e3 * given_m * _scale_to_fit(board, sheets[-1])
    width_mm, height_mm = (1e3 * length for length in board.size_m)
    raise SettingsError(
        f"the board does not fit on {sheets[-1].name}",
        got=f"{width_mm:g} x {height_mm:g} mm without margin",
        expected=f"{said} of at most {np.floor(10 * largest_mm) / 10:g} mm there",
        hint=f"a larger --paper (a3, a2, 600x400mm), or smaller {said}",
    )


def _turned(name: str, board: CalibrationBoard) -> Sheet:
    custom = _CUSTOM.fullmatch(name)
    if custom is None and name not in _PAPERS_MM:
        known = ", ".join(_PAPERS_MM) + " or 600x400mm"
        raise SettingsError("unknown paper", got=name, expected=known)
    sides = (float(custom[1]), float(custom[2])) if custom else _PAPERS_MM[name]
    if min(sides) <= 2 * _SMALLEST_MARGIN_MM:
        raise SettingsError("paper is too small for any board", got=name)
    across = board.size_m[0] >= board.size_m[1]
    short, long = sorted(sides)
    return Sheet(name, long, short) if across else Sheet(name, short, long)


def _scale_to_fit(board: CalibrationBoard, sheet: Sheet) -> float:
    """Return the factor by which the squares could grow (above 1) or must shrink on a sheet."""
    paper_mm = np.array([sheet.width_mm, sheet.height_mm])
    squares = np.array(board.size_m) / board.square_m
    narrow, wide = paper_mm / (squares + 2 * _MARGIN_SQUARES), paper_mm - 2 * _SMALLEST_MARGIN_MM
    return float(min(*narrow, *(wide / squares)) / (1e3 * board.square_m))


def _draw(board: CalibrationBoard, sheet: Sheet, kind: str, dpi: float) -> bytes:
    figure = Figure((sheet.width_mm / _MM_PER_IN, sheet.height_mm / _MM_PER_IN), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))  # in millimetres, from the upper left corner
    axes.set_axis_off()
    axes.set_xlim(0, sheet.width_mm)
    axes.set_ylim(sheet.height_mm, 0)
    width_mm, height_mm = (1e3 * length for length in board.size_m)
    left_mm, top_mm = (sheet.width_mm - width_mm) / 2, (sheet.height_mm - height_mm) / 2
    if kind == "png":  # align squares with pixels
        pixel_mm = _MM_PER_IN / dpi
        left_mm, top_mm = (round(mm / pixel_mm) * pixel_mm for mm in (left_mm, top_mm))
    first_m = board.margin_m - board.corners_m[:, :2].min(axis=0)
    dark_mm = 1e3 * (dark_polygons(board) + first_m) + (left_mm, top_mm)
    axes.add_patch(PathPatch(_outline(dark_mm), facecolor="black", linewidth=0))
    _note(axes, board, sheet, top_mm)
    buffer = io.BytesIO()
    # Without the date, equal boards give equal files.
    undated = {"CreationDate": None} if kind == "pdf" else {}
    figure.savefig(buffer, format=kind, dpi=dpi, metadata=undated)
    return buffer.getvalue()


def _outline(polygons_mm: Float64) -> Outline:
    """Return all polygons (M, K, 2) as one path, so that neighbours are filled without a seam."""
    count, sides = polygons_mm.shape[:2]
    closed = np.concatenate([polygons_mm, polygons_mm[:, :1]], axis=1)
    one = [Outline.MOVETO, *[Outline.LINETO] * (sides - 1), Outline.CLOSEPOLY]
    return Outline(closed.reshape(-1, 2), one * count)


def _note(axes: Axes, board: CalibrationBoard, sheet: Sheet, margin_mm: float) -> None:
    """Draw a description of the board, and a ruler to check the scale of a print."""
    size_mm = min(2.5, 0.2 * margin_mm)
    y = sheet.height_mm - max(0.4 * margin_mm, 5.0)
    ruler_mm = min(_RULER_MM, 10 * (sheet.width_mm // 25))
    left = sheet.width_mm - ruler_mm - 2 * _SMALLEST_MARGIN_MM / 2
    axes.add_patch(Rectangle((left, y), ruler_mm, 0.3, facecolor=_FAINT, linewidth=0))
    for end in (left, left + ruler_mm - 0.3):
        axes.add_patch(Rectangle((end, y - 1.0), 0.3, 2.3, facecolor=_FAINT, linewidth=0))
    font: dict[str, Any] = {"fontsize": size_mm / _POINT_MM, "color": _FAINT, "va": "bottom"}
    axes.text(_SMALLEST_MARGIN_MM, y, f"{board}   print at 100 %", **font)
    axes.text(left + ruler_mm / 2, y - 0.5, f"{ruler_mm:g} mm", ha="center", **font)
