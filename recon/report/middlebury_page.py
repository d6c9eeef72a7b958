"""The report of an evaluation on Middlebury scenes: page, tables, and colour images."""

from __future__ import annotations

import io
from collections.abc import Mapping
from itertools import product
from typing import Any, Final

import numpy as np
import PIL.Image

from recon.core.text import counted
from recon.core.values.arrays import UInt8
from recon.evaluation.disparity import KINDS
from recon.evaluation.middlebury.bench import SceneResult
from recon.evaluation.middlebury.score import MASKS, error_map
from recon.io.atomic import write_text
from recon.io.images.image import write_image
from recon.report import style
from recon.report.page import write_page
from recon.report.pair_page import ERROR_LIMIT_PX
from recon.report.sections import (
    NOT_KNOWN,
    Image,
    Page,
    Row,
    Section,
    Table,
    at,
    csv_text,
    join,
    known,
    number,
)
from recon.run.directory import RunDirectory

Figures = Mapping[str, Any]  # as in ``summary.json``
Path = tuple[str, ...]  # keys of a figure in them
_WIDTH_PX: Final = 300  # largest width of an image in the report
_GAP_PX: Final = 6
_LEAST_RATIO: Final = 0.001
_ABOUT: Final = (
    "bad and invalid in per cent of the pixels; avgerr, rms and a50 to a99 in pixels of the full "
    "size. nonocc: pixels that both cameras see; all: occluded ones too. dense: with holes filled; "
    "sparse: only pixels with a value. Of measured and of inferred pixels alone: fraction of the "
    "pixels, and of these those that are wrong, by more than 3 px of the map. ece, ause and sigma: "
    "docs/evaluation.md."
)


def draw_result(result: SceneResult, run: RunDirectory) -> None:
    """Write disparity, in colours of the range of the truth, and error of a result as images."""
    scene, values = result.scene, result.disparity.values
    scale = round(4 * values.shape[1] / scene.truth.values.shape[1]) / 4
    low, high = style.value_range(scene.truth.values)
    stem = f"pictures/{result.matcher}/{scene.name}"
    disparity = style.colour_disparity(values, (low * scale, high * scale))
    disparity = style.hatch(disparity, result.disparity.inferred)
    write_image(run.path(f"{stem}_disparity.png"), disparity)
    error = style.colour_error(error_map(scene, values), ERROR_LIMIT_PX)
    write_image(run.path(f"{stem}_error.png"), error)


def write_middlebury_page(summary: Mapping[str, Any], run: RunDirectory) -> None:
    """Write the tables as text, Markdown, LaTeX and CSV, and ``report.html``."""
    tables = middlebury_tables(summary)
    for suffix, form in (("txt", Table.text), ("md", Table.markdown), ("tex", Table.latex)):
        write_text(run.path(f"tables.{suffix}"), join(map(form, tables)))
    write_text(run.path("figures.csv"), csv_table(summary))
    matchers = summary["matchers"]
    curves = {name: one["weighted"]["confidence"] for name, one in matchers.items()}
    rated = {name: one for name, one in curves.items() if one}
    network = [(name, str(value)) for name, value in (summary.get("network") or {}).items()]
    scenes = scene_names(matchers)
    sections = [
        Section("Tables", [*tables, Table("Network of onnx", ("what", "value"), network)], _ABOUT),
        Section("Confidence", [
            Image("Reliability", reliability_figure(rated) if rated else None,
                  "A pixel is right if it is off by at most one pixel of the map. Above the dashed "
                  "line, pixels are right more often than the confidence says. Matchers without a "
                  "confidence are left out."),
            Image("Sparsification", sparsification_figure(rated) if rated else None,
                  "The closer to the dotted line, the better the confidence ranks the errors."),
        ]),
        Section("Scenes", [_scene(name, summary, run) for name in scenes]),
    ]  # fmt: skip
    bad = {n: at(one, "weighted", "nonocc", "dense", "bad", "2") for n, one in matchers.items()}
    figures = [(f"{n}: bad 2, nonocc, dense", known("{:.1f} %", x)) for n, x in bad.items()]
    subtitle = f"{counted(len(scenes), 'scene')} of {summary['folder']}, {summary['seconds']:.0f} s"
    title = f"Middlebury: {', '.join(matchers)}"
    write_page(Page(title, subtitle, figures, sections, summary), run)


@style.styled
def reliability_figure(matchers: Mapping[str, Figures]) -> bytes:
    """Draw how many pixels are correct by confidence; below, how many are in each bin."""
    ratios: dict[str, Any] = {"sharex": True, "height_ratios": (4, 1)}
    figure, (upper, lower) = style.subplots(style.HALF_IN, 5.0, 2, **ratios)
    upper.plot((0, 1), (0, 1), color=style.FAINT, linestyle="--", linewidth=1, label="calibrated")
    for n, (name, curves) in enumerate(matchers.items()):
        bins, colour = curves["reliability"], f"C{n}"
        confidence, right, ratio = _floats(bins, "confidence", "right", "ratio")
        shown = ratio >= _LEAST_RATIO
        label = f"{name}: ECE {curves['ece']:.3f}"
        upper.plot(confidence[shown], right[shown], "o-", color=colour, markersize=4, label=label)
        width = 1 / len(ratio) / len(matchers)
        places = np.arange(len(ratio)) / len(ratio) + (n + 0.5) * width
        lower.bar(places, ratio, width=0.9 * width, color=colour)
    upper.set(ylim=(0, 1), ylabel="fraction of right pixels")
    upper.legend(loc="upper left")
    lower.set(xlim=(0, 1), xlabel="confidence", ylabel="fraction of pixels")
    return style.to_png(figure)


@style.styled
def sparsification_figure(matchers: Mapping[str, Figures]) -> bytes:
    """Draw the fraction of wrong pixels left as the least confident ones are removed."""
    figure, axes = style.subplots(style.HALF_IN, 5.0)
    for n, (name, curves) in enumerate(matchers.items()):
        steps, colour = curves["sparsification"], f"C{n}"
        removed, wrong, best = 100 * _floats(steps, "removed", "wrong", "best")
        axes.plot(removed, wrong, color=colour, label=f"{name}: AUSE {curves['ause']:.3f}")
        axes.plot(removed, best, color=colour, linewidth=1.0, linestyle=":")
    axes.plot([], [], color=style.FAINT, linestyle=":", label="if the wrong ones went first")
    axes.set(xlabel="pixels removed, the least certain first (%)", xlim=(0, 100), ylim=(0, None))
    axes.set_ylabel("wrong among the rest (%)")
    axes.legend(loc="upper right")
    return style.to_png(figure)


def _floats(curves: Figures, *names: str) -> Any:
    return np.array([curves[name] for name in names], dtype=np.float64)  # None becomes NaN


def _scene(scene: str, summary: Mapping[str, Any], run: RunDirectory) -> Image:
    """Return disparity and error of each matcher, row by row."""
    names = [name for name, found in summary["matchers"].items() if scene in found["scenes"]]
    rows = [np.hstack(_small_images(run, f"pictures/{name}/{scene}")) for name in names]
    buffer = io.BytesIO()
    PIL.Image.fromarray(np.vstack(rows)[:-_GAP_PX, :-_GAP_PX]).save(buffer, "PNG")
    caption = (
        f"From top to bottom: {', '.join(names)}. Left the disparity, right its error: blue is "
        f"right, red is off by {ERROR_LIMIT_PX:g} full-size pixels or more, black is unknown, "
        "hatched is inferred from planes around."
    )
    return Image(scene, buffer.getvalue(), caption)


def _small_images(run: RunDirectory, stem: str) -> list[UInt8]:
    """Return disparity and error in one size, with a white strip to the right and below."""
    images = [PIL.Image.open(run.path(f"{stem}_{name}.png")) for name in ("disparity", "error")]
    width, height = images[1].size  # that of the ground truth
    shown = min(_WIDTH_PX, width)
    size = (shown, max(1, round(height * shown / width)))
    small = [np.asarray(image.resize(size, PIL.Image.Resampling.NEAREST)) for image in images]
    strips = ((0, _GAP_PX), (0, _GAP_PX), (0, 0))
    return [np.pad(image, strips, constant_values=255) for image in small]


_LIMITS: Final = ("0.5", "1", "2", "4")
_LENGTHS: Final = ("avgerr", "rms", "a50", "a90", "a95", "a99")
_DEPTHS: Final = ("mean_m", "median_m", "rms_m", "median_percent", "over_5_percent", "infinite")
_CONFIDENCE: Final = ("ece", "ause", "within_1_sigma", "within_2_sigma")
_KINDS: Final = tuple((mask, holes) for mask in MASKS for holes in ("dense", "sparse"))
_UNITS: Final = "bad and invalid in %, avgerr to a99 in px"
_ERRORS: Final = {"bad 1 (%)": ("bad", "1"), "bad 2 (%)": ("bad", "2"), "avgerr (px)": ("avgerr",)}


def middlebury_tables(summary: Figures) -> list[Table]:
    """Return all tables: weighted means of each mask and filling, then figures of each scene."""
    matchers = summary["matchers"]
    averaged, scenes = len(summary["mean_over"]), len(scene_names(matchers))
    some = f" of {averaged} of {counted(scenes, 'scene')}" if averaged < scenes else ""
    mean = f"Weighted mean{some}"
    tables = [
        _weighted_table(f"{mean}, {', '.join(kind)} ({_UNITS})", matchers, kind) for kind in _KINDS
    ]
    tables += [_kind_table(f"{mean}, {mask}, of each kind alone", matchers, mask) for mask in MASKS]
    for name, path in _ERRORS.items():
        title = f"{name} of each scene, nonocc, dense"
        tables.append(_scene_table(title, matchers, ("nonocc", "dense", *path)))
    rated = {name: one["weighted"].get("confidence") for name, one in matchers.items()}
    if any(rated.values()):
        rows = [(m, *(number(at(one, n), 3) for n in _CONFIDENCE)) for m, one in rated.items()]
        # The shares within sigma are best near those of a normal distribution, not at 0.
        title = f"Confidence, {mean.lower()}, all, sparse"
        tables.append(Table(title, ("matcher", *_CONFIDENCE), rows))
        for name in ("ece", "ause"):
            path = ("confidence", name)
            tables.append(_scene_table(f"{name} of each scene", matchers, path, digits=3))
    title = "seconds of each scene, matching alone"
    return [*tables, _scene_table(title, matchers, ("seconds",), digits=3)]


def scene_names(matchers: Figures) -> list[str]:
    """Return names of the scenes for which any matcher has a result, in order."""
    return list(dict.fromkeys(name for found in matchers.values() for name in found["scenes"]))


def csv_table(summary: Figures) -> str:
    """Return all figures: one row per scene, mask and filling."""
    named = [*_columns("", ""), *(f"depth_{name}" for name in _DEPTHS), *_CONFIDENCE]
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
                cells = [at(figures, *path) for path in paths]
                texts = ["" if cell is None else f"{cell:.6g}" for cell in cells]
                rows.append([matcher, scene, *kind, *texts, figures["seconds"]])
    return csv_text(rows)


def _columns(mask: str, holes: str) -> dict[str, Path]:
    """Return where each column is found; the invalid share is that of the unfilled map."""
    bad = {f"bad{limit}": (mask, holes, "bad", limit) for limit in _LIMITS}
    lengths = {name: (mask, holes, name) for name in _LENGTHS}
    return {**bad, "invalid": (mask, "invalid"), **lengths}


def _weighted_table(title: str, matchers: Figures, kind: tuple[str, str]) -> Table:
    columns = _columns(*kind)
    rows: list[Row] = []
    for name, found in matchers.items():
        figures = found["weighted"]
        depth = number(at(figures, *kind, "depth", "median_percent"))
        shown = depth if depth == NOT_KNOWN else f"{depth} %"
        cells = [number(at(figures, *path)) for path in columns.values()]
        rows.append((name, *cells, shown, number(figures["seconds"], 3)))
    return Table(title, ("matcher", *columns, "depth error", "seconds"), rows, best="columns")


def _kind_table(title: str, matchers: Figures, mask: str) -> Table:
    rows = []
    for name, kind in product(matchers, KINDS):
        found = matchers[name]["weighted"]
        cells = (at(found, mask, kind, *path) for path in (("ratio",), ("bad", "2"), ("wrong",)))
        # Of all pixels, occluded ones too.
        ece = at(found, "confidence", f"ece_{kind}") if mask == "all" else None
        rows.append((f"{name}, {kind}", *map(number, cells), number(ece, 3)))
    return Table(title, ("matcher", "share (%)", "bad 2 (%)", "wrong (%)", "ece"), rows)


def _scene_table(title: str, matchers: Figures, path: Path, digits: int = 2) -> Table:
    """Return one row per scene, one column per matcher."""
    rows = [
        (scene, *(number(at(one, "scenes", scene, *path), digits) for one in matchers.values()))
        for scene in scene_names(matchers)
    ]
    return Table(title, ("scene", *matchers), rows, best="rows")
