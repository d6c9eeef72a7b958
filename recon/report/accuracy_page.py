"""The page about the accuracy of a map in the coordinates of a survey: a view of its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from recon.core.text import counted, metres
from recon.core.values.arrays import Float64
from recon.export.accuracy import AccuracyFigures, ErrorFigures
from recon.map.sessions.georeference import ControlFigures
from recon.report import style
from recon.report.page import write_page
from recon.report.sections import NOT_KNOWN, Image, Page, Section, Table, known
from recon.run.directory import RunDirectory

_HEAD: Final = (
    "", "east", "north", "up", "horizontal", "3d", "σ east", "σ north", "σ up", "images", "note",
)  # fmt: skip
_SPREADS: Final = {
    "sigma_m": ("standard deviation of a place (m)", "{:.3f}"),
    "gsd_m": ("ground sampling distance (m)", "{:.4f}"),
    "frames": ("frames that saw a place on the ground", "{:.0f}"),
    "keyframe_overlap": ("ground of a keyframe that the next one saw", "{:.0%}"),
}
_CELLS: Final = 160  # of the sigma map, across


def write_accuracy_page(found: AccuracyFigures, places: Float64, run: RunDirectory) -> None:
    """Write ``accuracy.html``; ``places`` are those of `measure_accuracy`."""
    points = (found.survey.control or {}).items()
    check, control = ({n: one for n, one in points if one.check == kind} for kind in (True, False))
    spreads = [
        (name, *map(form.format, found.spreads[key].values()))
        for key, (name, form) in _SPREADS.items()
        if key in found.spreads
    ]
    drives = [
        (key.replace("_", " "), *(_text(one[key]) for one in found.drives))
        for key in found.drives[0]
    ]
    files = {"Products": found.products_sha256, "Made of": found.inputs_sha256}
    sections = [
        Section("Errors", [
            _errors("Check points", check, found.check, found.tested),
            _errors("Control points, which place the map", control, found.control),
            _errors("Positions along the path, which place the map", {}, found.path),
        ], f"Map minus survey, in metres; σ is what was expected. Coordinates of points are taken "
           f"as surveyed to {found.surveyed_m:g} m."),
        Section("Map and images", [
            Image("Standard deviation of places", _sigma_map(places),
                  "Seen from above: of all three coordinates together, by the points and by how "
                  "well the map is placed, but without the drift of its path."),
            Table("Seen", ("figure", "median", "5 %", "95 %"), spreads),
            Table("Drives", (), drives),
        ]),
        Section("Files", [Table(title, (), [(digest, name) for name, digest in one.items()])
                          for title, one in files.items()],
                "The page is about these files alone: sha256sum says whether a file is one."),
    ]  # fmt: skip
    kinds = {"Check points": found.check, "Control points": found.control, "Path": found.path}
    shown = [
        (f"{name}, RMSE {axis}", metres(one.rmse_m[axis]))
        for name, one in kinds.items()
        if one is not None
        for axis in ("horizontal", "up", "3d")
    ]
    placed = counted(found.survey.positions, "position" if found.path else "control point")
    where = f"{found.system or 'unknown coordinate system'}, placed by {placed}"
    subtitle = f"{where}. {found.statement} {found.made_utc}"
    page = Page("Accuracy", subtitle, shown, sections, {}, found.warnings)
    write_page(page, run, "accuracy.html")


def _errors(
    title: str,
    points: Mapping[str, ControlFigures],
    of: ErrorFigures | None,
    tested: ErrorFigures | None = None,
) -> Table:
    """Return the table of points and of their errors; points that have a note are marked."""
    rows = []
    for name, one in points.items():
        off = (one.east_m, one.north_m, one.up_m)
        sigma = (one.sigma_east_m, one.sigma_north_m, one.sigma_up_m)
        numbers = (*off, math.hypot(*off[:2]), math.hypot(*off), *sigma)
        rows.append((name, *map(_text, numbers), ", ".join(one.images), one.note))
    means = {} if of is None else {f"mean of {of.points}": of.mean_m, "RMSE": of.rmse_m}
    if tested is not None:
        means["RMSE with that of the survey"] = tested.rmse_m
    for name, each in means.items():
        rows.append((name, *map(_text, each.values()), *[""] * (len(_HEAD) - len(each) - 1)))
    return Table(title, _HEAD, rows, bad=[name for name, one in points.items() if one.note])


def _text(value: Any) -> str:
    number = value is None or isinstance(value, float)
    return known("{:.3f}", value, NOT_KNOWN) if number else str(value)


@style.styled
def _sigma_map(places: Float64) -> bytes | None:
    """Draw the standard deviations of places (N, 4) from above; None where none is known."""
    east, north, _, sigma_m = places[np.isfinite(places[:, 3])].T
    if not len(east):
        return None
    ratio = float(np.clip(np.ptp(north) / max(float(np.ptp(east)), 1e-9), 0.2, 0.8))
    low, high = style.value_range(sigma_m)
    figure, axes = style.subplots(style.WIDE_IN, style.WIDE_IN * ratio + 0.8)
    cells = (_CELLS, int(_CELLS * ratio))
    drawn = axes.hexbin(east, north, sigma_m, cells, cmap="turbo", vmin=low, vmax=high, mincnt=1)
    axes.set(xlabel="east (m)", ylabel="north (m)", aspect="equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    figure.colorbar(drawn, label="standard deviation (m)", extend="max", shrink=0.7)
    return style.to_png(figure, f"Standard deviations are {style.spread(sigma_m, ' m')}")
