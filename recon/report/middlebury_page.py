"""The report of an evaluation on Middlebury scenes, its tables and its colour images."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from recon.core.values.arrays import UInt8
from recon.evaluation.middlebury.bench import SceneResult
from recon.evaluation.middlebury.score import error_map
from recon.io.atomic import write_text
from recon.io.images.image import write_image
from recon.report.colour import colour_disparity, colour_error, value_range
from recon.report.middlebury_tables import csv_table, middlebury_tables, scene_names
from recon.report.page import write_page
from recon.report.pair_figures import ERROR_LIMIT_PX
from recon.report.style import FAINT, HALF_IN, styled, to_png
from recon.report.table import Table, join
from recon.run.directory import RunDirectory

Curves = Mapping[str, Any]
"""Curves of one matcher, as in ``summary.json``: ``reliability`` and ``sparsification``."""

_WIDTH_PX: Final = 300  # largest width of an image in the report
_GAP_PX: Final = 6
_LEAST_SHARE: Final = 0.001


def draw_result(result: SceneResult, run: RunDirectory) -> None:
    """Write the disparity and the error of a result as colour images.

    In the error, blue is correct, red is wrong by `ERROR_LIMIT_PX` full-size pixels or more, and
    dark is unknown ground truth; holes are filled. Disparity colours span the range of the truth.
    """
    scene, values = result.scene, result.values
    scale = round(4 * values.shape[1] / scene.truth.values.shape[1]) / 4
    low, high = value_range(scene.truth.values)
    stem = f"pictures/{result.matcher}/{scene.name}"
    disparity = colour_disparity(values, low * scale, high * scale)
    write_image(run.path(f"{stem}_disparity.png"), disparity)
    error = colour_error(error_map(scene, values), ERROR_LIMIT_PX)
    write_image(run.path(f"{stem}_error.png"), error)


def write_middlebury_page(summary: Mapping[str, Any], run: RunDirectory) -> None:
    """Write the tables as text, Markdown, LaTeX and CSV, and ``report.html``."""
    tables = middlebury_tables(summary)
    for suffix, form in (("txt", Table.text), ("md", Table.markdown), ("tex", Table.latex)):
        write_text(run.path(f"tables.{suffix}"), join(map(form, tables)))
    write_text(run.path("figures.csv"), csv_table(summary))
    found = {name: one["weighted"]["confidence"] for name, one in summary["matchers"].items()}
    rated = {name: curves for name, curves in found.items() if curves}
    write_page(
        "middlebury",
        run,
        found=summary,
        tables=tables,
        reliability=reliability_figure(rated) if rated else None,
        sparsification=sparsification_figure(rated) if rated else None,
        scenes=[_scene(name, summary, run) for name in scene_names(summary["matchers"])],
        warnings=summary["warnings"],
    )


@styled
def reliability_figure(matchers: Mapping[str, Curves]) -> bytes:
    """Draw the fraction of correct pixels by confidence (reliability diagram).

    Bins with less than a thousandth of the pixels are left out; the bars show the distribution of
    the pixels over the bins.
    """
    figure = Figure((HALF_IN, 5.0))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    upper.plot((0, 1), (0, 1), color=FAINT, linestyle="--", linewidth=1, label="calibrated")
    for n, (name, curves) in enumerate(matchers.items()):
        bins, colour = curves["reliability"], f"C{n}"
        confidence, right, share = _floats(bins, "confidence", "right", "share")
        shown = share >= _LEAST_SHARE
        label = f"{name}: ECE {curves['ece']:.3f}"
        upper.plot(confidence[shown], right[shown], "o-", color=colour, markersize=4, label=label)
        width = 1 / len(share) / len(matchers)
        places = np.arange(len(share)) / len(share) + (n + 0.5) * width
        lower.bar(places, share, width=0.9 * width, color=colour)
    upper.set(ylim=(0, 1), ylabel="share of right pixels")
    upper.legend(loc="upper left")
    lower.set(xlim=(0, 1), xlabel="confidence", ylabel="share of pixels")
    return to_png(figure)


@styled
def sparsification_figure(matchers: Mapping[str, Curves]) -> bytes:
    """Draw the fraction of wrong pixels left as the least confident ones are removed."""
    figure = Figure((HALF_IN, 5.0))
    axes = figure.subplots()
    for n, (name, curves) in enumerate(matchers.items()):
        steps, colour = curves["sparsification"], f"C{n}"
        removed, wrong, best = 100 * _floats(steps, "removed", "wrong", "best")
        axes.plot(removed, wrong, color=colour, label=f"{name}: AUSE {curves['ause']:.3f}")
        axes.plot(removed, best, color=colour, linewidth=1.0, linestyle=":")
    axes.plot([], [], color=FAINT, linestyle=":", label="if the wrong ones went first")
    axes.set(xlim=(0, 100), ylim=(0, None))
    axes.set(
        xlabel="pixels removed, the least certain first (%)", ylabel="wrong among the rest (%)"
    )
    axes.legend(loc="upper right")
    return to_png(figure)


def _floats(curves: Curves, *names: str) -> Any:
    """Return float64 (names, N), with NaN for None."""
    return np.array([curves[name] for name in names], dtype=np.float64)


def _scene(scene: str, summary: Mapping[str, Any], run: RunDirectory) -> dict[str, Any]:
    """Return what the page shows of a scene: disparity and error of each matcher, row by row."""
    names = [name for name, found in summary["matchers"].items() if scene in found["scenes"]]
    rows = [np.hstack(_small_images(run, f"pictures/{name}/{scene}")) for name in names]
    buffer = io.BytesIO()
    Image.fromarray(np.vstack(rows)[:-_GAP_PX, :-_GAP_PX]).save(buffer, "PNG")
    return {"name": scene, "matchers": names, "png": buffer.getvalue()}


def _small_images(run: RunDirectory, stem: str) -> list[UInt8]:
    """Return disparity and error in one size, with a white strip to the right and below."""
    # The error has the size of the ground truth, which is that of no or every matcher's result.
    images = [Image.open(run.path(f"{stem}_{name}.png")) for name in ("disparity", "error")]
    width, height = images[1].size
    shown = min(_WIDTH_PX, width)
    size = (shown, max(1, round(height * shown / width)))
    small = [np.asarray(image.resize(size, Image.Resampling.NEAREST)) for image in images]
    strips = ((0, _GAP_PX), (0, _GAP_PX), (0, 0))
    return [np.pad(image, strips, constant_values=255) for image in small]
