"""The page about the accuracy of a map in the coordinates of a survey: a view of its figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from recon.core.text import counted, metres
from recon.core.values.arrays import Float64
from recon.export.accuracy import ENOUGH, AccuracyFigures
from recon.report import style
from recon.report.page import write_page
from recon.report.sections import Image, Page, Section, Table, known, row_of
from recon.run.directory import RunDirectory

_AXES: Final = ("east", "north", "up")
_HEAD: Final = ("", *_AXES, *(f"σ {axis}" for axis in _AXES), "images", "note")
_SPREADS: Final = {
    "sigma_m": ("standard deviation of a place (m)", "{:.3f}"),
    "gsd_m": ("ground sampling distance (m)", "{:.4f}"),
    "frames": ("frames that saw a place on the ground", "{:.0f}"),
    "keyframe_overlap": ("ground of a keyframe that the next one saw", "{:.0%}"),
}
_CELLS: Final = 160  # of the sigma map, across
Json = Mapping[str, Any]


def write_accuracy_page(figures: AccuracyFigures, places: Float64, run: RunDirectory) -> None:
    """Write ``accuracy.html``; ``places`` are those of `measure_accuracy`."""
    found = figures.to_json()
    kinds = {"check": "Check points", "control": "Control points", "path": "Path"}
    shown = [
        (f"{name}, RMSE {title}", metres(figures.errors[key].rmse_m[axis]))
        for key, name in kinds.items()
        if key in figures.errors
        for axis, title in {"horizontal": "horizontal", "up": "of height", "3d": "in 3-D"}.items()
    ]
    spreads = [
        row_of(name, found["spreads"][key], [(form, of) for of in ("median", "p5", "p95")])
        for key, (name, form) in _SPREADS.items()
        if key in found["spreads"]
    ]
    drives = found["drives"]
    of_drives = [
        (key.replace("_", " "), *(known("{:.7g}", one[key], str(one[key])) for one in drives))
        for key in drives[0]
        if any(one[key] is not None for one in drives)
    ]
    sections = [
        Section("Errors", [_errors(name, found, key) for key, name in kinds.items()],
                "Map minus survey, in metres. " + ("The positions place it: a misfit, no check."
                if "path" in figures.errors else "σ is what was expected, of points surveyed to "
                f"{figures.surveyed_m:g} m. Check points place nothing.")),
        Section("Map and images", [
            Image("Standard deviation of places", _sigma_map(places),
                  "Seen from above: of all three coordinates together, by the points and by how "
                  "well the map is placed, but without the drift of its path."),
            Table("Seen", ("figure", "median", "5 %", "95 %"), spreads),
            Table("Drives", (), of_drives),
        ]),
        Section("Files", [
            Table(f"SHA-256 of {kind}", (), [(digest, name) for name, digest in files.items()])
            for kind, files in figures.sha256.items()
        ], "The page is about these files alone: sha256sum says whether a file is one."),
    ]  # fmt: skip
    by = counted(
        figures.survey.positions, "position" if "path" in figures.errors else "control point"
    )
    where = f"{figures.system or 'unknown coordinate system'}, placed by {by}"
    subtitle = f"{where}. {figures.statement} {figures.made_utc}"
    tested = figures.errors.get("tested")
    few = tested is None or tested.points < ENOUGH
    doubts = [*([figures.statement] if few else []), *figures.warnings]
    page = Page("Accuracy", subtitle, shown, sections, {}, doubts)
    write_page(page, run, "accuracy.html")


def _errors(title: str, found: Json, key: str) -> Table:
    """Return the table of points of one kind and of their errors; those with a note are marked."""
    listed, kind = found["survey"].get("control") or {}, {"check": True, "control": False}.get(key)
    points = {name: one for name, one in listed.items() if one["check"] == kind}
    columns = [("{:.3f}", f"{of}{axis}_m") for of in ("", "sigma_") for axis in _AXES]
    rows = [
        (*row_of(name, one, columns), ", ".join(one["images"]), one["note"])
        for name, one in points.items()
    ]
    errors = dict[str, Mapping[str, float]]()
    if of := found["errors"].get(key):
        errors = {f"mean of {of['points']}": of["mean_m"], "RMSE": of["rmse_m"]}
    if of and kind:
        errors["RMSE with that of the survey"] = found["errors"]["tested"]["rmse_m"]
    for name, one in errors.items():
        both = (f"{axis} {error_m:.3f}" for axis, error_m in one.items() if axis not in _AXES)
        row = row_of(name, one, [("{:.3f}", axis) for axis in _AXES])
        rows.append((*row, "", "", "", "", ", ".join(both)))
    return Table(title, _HEAD, rows, bad=[name for name, one in points.items() if one["note"]])


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
