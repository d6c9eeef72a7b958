"""The tables of an evaluation on Middlebury scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

from recon.report.table import NOT_KNOWN, Row, Table, csv_text, number

Figures = Mapping[str, Any]

WEIGHTED: Final = "weighted"
_LIMITS: Final = ("0.5", "1", "2", "4")
_LENGTHS: Final = ("avgerr", "rms", "a50", "a90", "a95", "a99")
_DEPTHS: Final = ("mean_m", "median_m", "rms_m", "median_percent", "over_5_percent", "infinite")
_HEAD: Final = ("matcher", *(f"bad{t}" for t in _LIMITS), "invalid", *_LENGTHS)
_CONFIDENCE: Final = ("ece", "ause", "within_1_sigma", "within_2_sigma")
_KINDS: Final = (("nonocc", "dense"), ("nonocc", "sparse"), ("all", "dense"), ("all", "sparse"))


def middlebury_tables(summary: Figures) -> list[Table]:
    """Return all tables: weighted means of each mask and filling, then figures of each scene."""
    matchers, mean = summary["matchers"], _mean_title(summary)
    tables = [
        _weighted_table(f"{mean}, {mask}, {holes}", matchers, mask, holes) for mask, holes in _KINDS
    ]
    for limit in _LIMITS[1:3]:
        title = f"bad {limit} of each scene, nonocc, dense"
        tables.append(_scene_table(title, matchers, partial(_bad, limit)))
    title = "avgerr (px) of each scene, nonocc, dense"
    tables.append(_scene_table(title, matchers, lambda one: one["nonocc"]["dense"]["avgerr"]))
    if any(found["weighted"].get("confidence") for found in matchers.values()):
        tables.append(_confidence_table(f"Confidence, {mean.lower()}, all, sparse", matchers))
        tables += [
            _scene_table(f"{name} of each scene", matchers, partial(_rated, name), 3)
            for name in _CONFIDENCE[:2]
        ]
    title = "seconds of each scene, matching alone"
    return [*tables, _scene_table(title, matchers, lambda one: one["seconds"], 3)]


def scene_names(matchers: Figures) -> list[str]:
    """Return names of the scenes for which any matcher has a result, in order."""
    return list(dict.fromkeys(name for found in matchers.values() for name in found["scenes"]))


def csv_table(summary: Figures) -> str:
    """Return all figures of all matchers: one row per scene, mask and filling.

    Figures of the confidence are in the rows they refer to: all pixels that have a value.
    """
    depths = [f"depth_{name}" for name in _DEPTHS]
    names = [*_HEAD[1:], *depths, *_CONFIDENCE]
    rows = [[_HEAD[0], "scene", "mask", "holes", *names, "seconds"]]
    for matcher, found in summary["matchers"].items():
        for scene, figures in [*found["scenes"].items(), (WEIGHTED, found["weighted"])]:
            for mask, holes in _KINDS:
                cells = _all_cells(figures, mask, holes)
                rows.append([matcher, scene, mask, holes, *cells, figures["seconds"]])
    return csv_text(rows)


def _mean_title(summary: Figures) -> str:
    averaged, scenes = len(summary["mean_over"]), len(scene_names(summary["matchers"]))
    return "Weighted mean" + (f" of {averaged} of {scenes} scenes" if averaged < scenes else "")


def _weighted_table(title: str, matchers: Figures, mask: str, holes: str) -> Table:
    rows: list[Row] = []
    for name, found in matchers.items():
        figures = found["weighted"]
        depth = figures[mask][holes].get("depth", {}).get("median_percent")
        cells = [number(cell) for cell in _cells(figures, mask, holes)]
        shown = NOT_KNOWN if depth is None else f"{number(depth)} %"
        rows.append((name, *cells, shown, number(figures["seconds"], 3)))
    return Table(title, (*_HEAD, "depth error", "seconds"), rows, best="columns")


def _confidence_table(title: str, matchers: Figures) -> Table:
    rows = [
        (name, *(number(_rated(one, found["weighted"]), 3) for one in _CONFIDENCE))
        for name, found in matchers.items()
    ]
    # The shares within sigma are best near those of a normal distribution, not at 0.
    return Table(title, ("matcher", *_CONFIDENCE), rows)


def _scene_table(
    title: str, matchers: Figures, pick: Callable[[Figures], float | None], digits: int = 2
) -> Table:
    """Return one row per scene, one column per matcher."""
    rows: list[Row] = []
    for scene in scene_names(matchers):
        ones = (found["scenes"].get(scene) for found in matchers.values())
        rows.append((scene, *(number(None if one is None else pick(one), digits) for one in ones)))
    head = ("scene", *matchers)
    return Table(title, head, rows, best="rows")


def _bad(limit: str, figures: Figures) -> float | None:
    share: float | None = figures["nonocc"]["dense"]["bad"][limit]
    return share


def _rated(name: str, figures: Figures) -> float | None:
    """Return a figure of the confidence; None if the matcher has no confidence."""
    return (figures.get("confidence") or {}).get(name)


def _cells(figures: Figures, mask: str, holes: str) -> list[Any]:
    """Return cells in the order of the header; the invalid share is that of the unfilled map."""
    one = figures[mask][holes]
    bad = [one["bad"][limit] for limit in _LIMITS]
    return [*bad, figures[mask]["invalid"], *(one[name] for name in _LENGTHS)]


def _all_cells(figures: Figures, mask: str, holes: str) -> list[str]:
    depth = figures[mask][holes].get("depth", {})
    counted = (mask, holes) == _KINDS[-1]
    rated = [_rated(name, figures) if counted else None for name in _CONFIDENCE]
    cells = [*_cells(figures, mask, holes), *(depth.get(name) for name in _DEPTHS), *rated]
    return ["" if cell is None else f"{cell:.6g}" for cell in cells]
