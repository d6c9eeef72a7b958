"""The report of what changed between two days, and its table as a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from recon.io.atomic import write_text
from recon.map.changes.objects import ChangedObject
from recon.report.page import run_figures, run_section, write_page
from recon.report.sections import Image, Page, Row, Section, Table, csv_text, known
from recon.run.directory import RunDirectory

_HEAD: Final = ("", "change", "middle (m)", "size (m)", "volume (m³)", "first seen", "last seen",
                "pictures")  # fmt: skip
_CAPTION: Final = (
    "Middle and size (length × width × height) of a box in map axes. The volume is of what was "
    "seen from the drive, over the ground of the other day."
)


def _row(one: ChangedObject) -> Row:
    volume = known("{:.2f}", one.volume_m3, "–") + known(" ± {:.2f}", one.volume_sigma_m3)
    middle = ", ".join(f"{x:.1f}" for x in one.centre_m)
    size = f"{one.length_m:.1f} × {one.width_m:.1f} × {one.height_m:.1f}"
    ends = (
        f"{end.date or f'{end.time_s:.1f} s'}, frame {end.frame} of {end.drive}"
        for end in (one.first_seen, one.last_seen)
    )
    picture = "below" if one.picture else "no images"
    return (str(one.number), one.change, middle, size, volume, *ends, picture)


def write_changes_page(
    objects: Sequence[ChangedObject], summary: Mapping[str, Any], run: RunDirectory
) -> None:
    """Write ``report.html``: the table, and pictures of both days."""
    before, after, ratios = summary["before"], summary["after"], summary["not_compared_ratio"]
    pictures = [
        Image(f"{one.number}: {one.change}", run.path(one.picture).read_bytes(), "Before | after")
        for one in objects
        if one.picture is not None
    ]
    shown = [
        *((name.capitalize(), str(count)) for name, count in summary["changes"].items()),
        *((f"Not compared, {day}", f"{ratio:.0%}") for day, ratio in ratios.items()),
        *run_figures(summary),
    ]
    sections = [Section("Changes", [changes_table(objects), *pictures]), run_section(summary)]
    write_page(Page("What changed", f"{before} and {after}", shown, sections, summary), run)


def changes_table(objects: Sequence[ChangedObject]) -> Table:
    """Return the table of what changed; a row says if nothing did."""
    rows = [*map(_row, objects)] or [("", "nothing", *[""] * (len(_HEAD) - 2))]
    return Table("What came and went", _HEAD, rows, caption=_CAPTION)


def write_objects(path: Path, objects: Sequence[ChangedObject]) -> None:
    """Write the table of objects as CSV."""
    rows = [dict(_flat(one.to_json())) for one in objects]
    write_text(path, csv_text([[*rows[0]] if rows else [], *([*row.values()] for row in rows)]))


def _flat(found: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in found.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}_")
        elif isinstance(value, list):
            yield from zip((f"{name}_{axis}" for axis in "xyz"), value, strict=True)
        else:
            yield prefix + name, value
