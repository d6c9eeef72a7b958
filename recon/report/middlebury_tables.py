"""Tables of an evaluation on Middlebury scenes: plain text, Markdown, LaTeX, CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from recon.report.latex import latex_tabular

Row = Sequence[str]
Figures = Mapping[str, Any]

WEIGHTED: Final = "weighted"
_NOTHING: Final = "–"
_LIMITS: Final = ("0.5", "1", "2", "4")
_LENGTHS: Final = ("avgerr", "rms", "a50", "a90", "a95", "a99")
_DEPTHS: Final = ("mean_m", "median_m", "rms_m", "median_percent", "over_5_percent", "infinite")
_HEAD: Final = ("matcher", *(f"bad{t}" for t in _LIMITS), "invalid", *_LENGTHS)
_CONFIDENCE: Final = ("ece", "ause", "within_1_sigma", "within_2_sigma")
_KINDS: Final = (("nonocc", "dense"), ("nonocc", "sparse"), ("all", "dense"), ("all", "sparse"))


@dataclass(frozen=True)
class Table:
    """One table.

    Attributes:
        title: What it shows.
        rows: Its cells; the first row is the head, the first column names the rows.
        compared: Where the best, that is the smallest, number is looked for: in each column, in
            each row, or nowhere.
    """

    title: str
    rows: Sequence[Row]
    compared: Literal["columns", "rows", "nothing"]


def text_tables(summary: Figures) -> str:
    """The tables in columns, for a terminal."""
    return "\n\n".join(f"{one.title}\n{_columns(one.rows)}" for one in _tables(summary)) + "\n"


def markdown_tables(summary: Figures) -> str:
    """The tables in Markdown."""
    tables = (f"### {one.title}\n{_markdown(one.rows)}" for one in _tables(summary))
    return "\n\n".join(tables) + "\n"


def latex_tables(summary: Figures) -> str:
    """The tables in LaTeX, the best number of several in bold."""
    tables = (latex_tabular(one.rows, _best(one), title=one.title) for one in _tables(summary))
    return "\n\n".join(tables) + "\n"


def report_tables(summary: Figures) -> list[Table]:
    """All tables."""
    return list(_tables(summary))


def scene_names(matchers: Figures) -> list[str]:
    """Names of the scenes for which any matcher has a result, in order."""
    return list(dict.fromkeys(name for found in matchers.values() for name in found["scenes"]))


def csv_table(summary: Figures) -> str:
    """All figures of all matchers: one row per scene, mask and filling.

    Figures of the confidence are in the rows they refer to: all pixels that have a value.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    depths = [f"depth_{name}" for name in _DEPTHS]
    names = [*_HEAD[1:], *depths, *_CONFIDENCE]
    writer.writerow([_HEAD[0], "scene", "mask", "holes", *names, "seconds"])
    for matcher, found in summary["matchers"].items():
        for scene, figures in [*found["scenes"].items(), (WEIGHTED, found["weighted"])]:
            for mask, holes in _KINDS:
                cells = _all_cells(figures, mask, holes)
                writer.writerow([matcher, scene, mask, holes, *cells, figures["seconds"]])
    return out.getvalue()


def _tables(summary: Figures) -> Iterator[Table]:
    matchers, mean = summary["matchers"], _mean_title(summary)
    for mask, holes in _KINDS:
        rows = _weighted_rows(matchers, mask, holes)
        yield Table(f"{mean}, {mask}, {holes}", rows, "columns")
    for limit in _LIMITS[1:3]:
        rows = _scene_rows(matchers, lambda one, t=limit: one["nonocc"]["dense"]["bad"][t])
        yield Table(f"bad {limit} of each scene, nonocc, dense", rows, "rows")
    rows = _scene_rows(matchers, lambda one: one["nonocc"]["dense"]["avgerr"])
    yield Table("avgerr (px) of each scene, nonocc, dense", rows, "rows")
    if any(found["weighted"].get("confidence") for found in matchers.values()):
        # The shares within sigma are best near those of a normal distribution, not at 0.
        yield Table(
            f"Confidence, {mean.lower()}, all, sparse", _confidence_rows(matchers), "nothing"
        )
        for name in _CONFIDENCE[:2]:
            rows = _scene_rows(matchers, lambda one, n=name: _rated(one, n), digits=3)
            yield Table(f"{name} of each scene", rows, "rows")
    rows = _scene_rows(matchers, lambda one: one["seconds"], digits=3)
    yield Table("seconds of each scene, matching alone", rows, "rows")


def _mean_title(summary: Figures) -> str:
    averaged, scenes = len(summary["mean_over"]), len(scene_names(summary["matchers"]))
    return "Weighted mean" + (f" of {averaged} of {scenes} scenes" if averaged < scenes else "")


def _best(table: Table) -> set[tuple[int, int]]:
    """Row and column of the smallest number, as it is shown, of each row or column."""
    numbers = {
        (r, c): float(cell.removesuffix(" %"))
        for r, row in enumerate(table.rows)
        for c, cell in enumerate(row)
        if r and c and cell != _NOTHING
    }
    lines: dict[int, dict[tuple[int, int], float]] = {}
    for place, number in numbers.items():
        if table.compared != "nothing":
            lines.setdefault(place[table.compared == "columns"], {})[place] = number
    return {
        place
        for line in lines.values()
        if len(line) > 1
        for place, number in line.items()
        if number == min(line.values())
    }


def _weighted_rows(matchers: Figures, mask: str, holes: str) -> list[Row]:
    rows: list[Row] = [(*_HEAD, "depth error", "seconds")]
    for name, found in matchers.items():
        figures = found["weighted"][mask][holes]
        depth = figures.get("depth", {}).get("median_percent")
        cells = [_number(cell) for cell in _cells(found["weighted"], mask, holes)]
        shown = f"{_number(depth)} %" if depth is not None else _NOTHING
        rows.append((name, *cells, shown, _number(found["weighted"]["seconds"], 3)))
    return rows


def _confidence_rows(matchers: Figures) -> list[Row]:
    rows: list[Row] = [("matcher", *_CONFIDENCE)]
    for name, found in matchers.items():
        rows.append((name, *(_number(_rated(found["weighted"], one), 3) for one in _CONFIDENCE)))
    return rows


def _rated(figures: Figures, name: str) -> float | None:
    """A figure of the confidence; None if the matcher has no confidence."""
    return (figures.get("confidence") or {}).get(name)


def _scene_rows(matchers: Figures, pick: Any, digits: int = 2) -> list[Row]:
    """One row per scene, one column per matcher."""
    rows: list[Row] = [("scene", *matchers)]
    for scene in scene_names(matchers):
        ones = (found["scenes"].get(scene) for found in matchers.values())
        rows.append((scene, *(_number(None if one is None else pick(one), digits) for one in ones)))
    return rows


def _cells(figures: Figures, mask: str, holes: str) -> list[Any]:
    """Cells in the order of the header; the invalid share is that of the unfilled map."""
    one = figures[mask][holes]
    bad = [one["bad"][limit] for limit in _LIMITS]
    return [*bad, figures[mask]["invalid"], *(one[name] for name in _LENGTHS)]


def _all_cells(figures: Figures, mask: str, holes: str) -> list[Any]:
    depth = figures[mask][holes].get("depth", {})
    counted = (mask, holes) == _KINDS[-1]
    rated = [_rated(figures, name) if counted else None for name in _CONFIDENCE]
    cells = [*_cells(figures, mask, holes), *(depth.get(name) for name in _DEPTHS), *rated]
    return ["" if cell is None else f"{cell:.6g}" for cell in cells]


def _number(value: float | None, digits: int = 2) -> str:
    return _NOTHING if value is None else f"{value:.{digits}f}"


def _columns(rows: Sequence[Row]) -> str:
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return "\n".join(_line(row, widths) for row in rows)


def _line(row: Row, widths: Sequence[int]) -> str:
    first, *others = zip(row, widths, strict=True)
    cells = [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]
    return "  ".join(cells).rstrip()


def _markdown(rows: Sequence[Row]) -> str:
    rule = ["---", *["---:"] * (len(rows[0]) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (rows[0], rule, *rows[1:]))
