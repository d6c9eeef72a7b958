"""The tables of an evaluation on Middlebury scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from recon.core.words import counted
from recon.report.table import NOT_KNOWN, Row, Table, csv_text, number

Figures = Mapping[str, Any]
Path = tuple[str, ...]

_LIMITS: Final = ("0.5", "1", "2", "4")
_LENGTHS: Final = ("avgerr", "rms", "a50", "a90", "a95", "a99")
_DEPTHS: Final = ("mean_m", "median_m", "rms_m", "median_percent", "over_5_percent", "infinite")
_CONFIDENCE: Final = ("ece", "ause", "within_1_sigma", "within_2_sigma")
_KINDS: Final = (("nonocc", "dense"), ("nonocc", "sparse"), ("all", "dense"), ("all", "sparse"))
_UNITS: Final = "bad and invalid in %, avgerr to a99 in px"
_OF_EACH_SCENE: Final = {
    "bad 1 (%) of each scene, nonocc, dense": ("nonocc", "dense", "bad", "1"),
    "bad 2 (%) of each scene, nonocc, dense": ("nonocc", "dense", "bad", "2"),
    "avgerr (px) of each scene, nonocc, dense": ("nonocc", "dense", "avgerr"),
}


def middlebury_tables(summary: Figures) -> list[Table]:
    """Return all tables: weighted means of each mask and filling, then figures of each scene."""
    matchers = summary["matchers"]
    averaged, scenes = len(summary["mean_over"]), len(scene_names(matchers))
    some = f" of {averaged} of {counted(scenes, 'scene')}" if averaged < scenes else ""
    mean = f"Weighted mean{some}"
    tables = [
        _weighted_table(f"{mean}, {', '.join(kind)} ({_UNITS})", matchers, kind) for kind in _KINDS
    ]
    tables += [_scene_table(title, matchers, path) for title, path in _OF_EACH_SCENE.items()]
    if any(_at(found, ("weighted", "confidence")) for found in matchers.values()):
        tables.append(_confidence_table(f"Confidence, {mean.lower()}, all, sparse", matchers))
        tables += [
            _scene_table(f"{name} of each scene", matchers, ("confidence", name), digits=3)
            for name in ("ece", "ause")
        ]
    title = "seconds of each scene, matching alone"
    return [*tables, _scene_table(title, matchers, ("seconds",), digits=3)]


def scene_names(matchers: Figures) -> list[str]:
    """Return names of the scenes for which any matcher has a result, in order."""
    return list(dict.fromkeys(name for found in matchers.values() for name in found["scenes"]))


def csv_table(summary: Figures) -> str:
    """Return all figures of all matchers: one row per scene, mask and filling.

    Figures of the confidence are in the rows they refer to: all pixels that have a value.
    """
    depths = [f"depth_{name}" for name in _DEPTHS]
    named = [*_columns("", ""), *depths, *_CONFIDENCE]
    rows = [["matcher", "scene", "mask", "holes", *named, "seconds"]]
    for matcher, found in summary["matchers"].items():
        for scene, figures in [*found["scenes"].items(), ("weighted", found["weighted"])]:
            for kind in _KINDS:
                rated = "confidence" if kind == _KINDS[-1] else ""
                paths = [
                    *_columns(*kind).values(),
                    *((*kind, "depth", name) for name in _DEPTHS),
                    *((rated, name) for name in _CONFIDENCE),
                ]
                cells = [_at(figures, path) for path in paths]
                texts = ["" if cell is None else f"{cell:.6g}" for cell in cells]
                rows.append([matcher, scene, *kind, *texts, figures["seconds"]])
    return csv_text(rows)


def _columns(mask: str, holes: str) -> dict[str, Path]:
    """Return where each column is found; the invalid share is that of the unfilled map."""
    bad = {f"bad{limit}": (mask, holes, "bad", limit) for limit in _LIMITS}
    lengths = {name: (mask, holes, name) for name in _LENGTHS}
    return {**bad, "invalid": (mask, "invalid"), **lengths}


def _at(figures: Figures, path: Path) -> Any:
    """Return a figure by its keys; None where there is none."""
    found: Any = figures
    for key in path:
        found = (found or {}).get(key)
    return found


def _weighted_table(title: str, matchers: Figures, kind: tuple[str, str]) -> Table:
    columns = _columns(*kind)
    rows: list[Row] = []
    for name, found in matchers.items():
        figures = found["weighted"]
        depth = number(_at(figures, (*kind, "depth", "median_percent")))
        shown = depth if depth == NOT_KNOWN else f"{depth} %"
        cells = [number(_at(figures, path)) for path in columns.values()]
        rows.append((name, *cells, shown, number(figures["seconds"], 3)))
    return Table(title, ("matcher", *columns, "depth error", "seconds"), rows, best="columns")


def _confidence_table(title: str, matchers: Figures) -> Table:
    paths = [("weighted", "confidence", name) for name in _CONFIDENCE]
    rows = [(m, *(number(_at(one, path), 3) for path in paths)) for m, one in matchers.items()]
    # The shares within sigma are best near those of a normal distribution, not at 0.
    return Table(title, ("matcher", *_CONFIDENCE), rows)


def _scene_table(title: str, matchers: Figures, path: Path, digits: int = 2) -> Table:
    """Return one row per scene, one column per matcher."""
    rows = [
        (scene, *(number(_at(one, ("scenes", scene, *path)), digits) for one in matchers.values()))
        for scene in scene_names(matchers)
    ]
    return Table(title, ("scene", *matchers), rows, best="rows")
