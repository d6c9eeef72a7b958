"""The report of an evaluation on Middlebury scenes, its tables and its colour images."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from recon.evaluation.middlebury.bench import SceneResult
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

    Raises:
        OutputError: A file cannot be written.
    """
    scale = round(4 * result.values.shape[1] / result.scene.truth.values.shape[1]) / 4
    low, high = value_range(result.scene.truth.values)
    images = {
        "disparity": colour_disparity(result.values, low * scale, high * scale),
        "error": colour_error(result.error_px(), ERROR_LIMIT_PX),
    }
    for name, image in images.items():
        path = run.path(f"pictures/{result.matcher}/{result.scene.name}_{name}.png")
        write_image(path, image)


def write_middlebury_page(summary: Mapping[str, Any], run: RunDirectory) -> None:
    """Write the tables as text, Markdown, LaTeX and CSV, and ``report.html``.

    Raises:
        OutputError: A file cannot be written.
    """
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
        confidence, right, share = (_floats(bins[key]) for key in ("confidence", "right", "share"))
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
        removed, wrong, best = (100 * _floats(steps[key]) for key in ("removed", "wrong", "best"))
        axes.plot(removed, wrong, color=colour, label=f"{name}: AUSE {curves['ause']:.3f}")
        axes.plot(removed, best, color=colour, linewidth=1.0, linestyle=":")
    axes.plot([], [], color=FAINT, linestyle=":", label="if the wrong ones went first")
    axes.set(xlim=(0, 100), ylim=(0, None))
    axes.set(
        xlabel="pixels removed, the least certain first (%)", ylabel="wrong among the rest (%)"
    )
    axes.legend(loc="upper right")
    return to_png(figure)


def _floats(values: Any) -> Any:
    """Return float64 array, with NaN for None."""
    return np.array(values, dtype=np.float64)


def _scene(scene: str, summary: Mapping[str, Any], run: RunDirectory) -> dict[str, Any]:
    """Return what the page shows of a scene: one row of images per matcher."""
    names = [name for name, found in summary["matchers"].items() if scene in found["scenes"]]
    buffer = io.BytesIO()
    rows = [_both_images(run, name, scene) for name in names]
    _joined(rows, down=True).save(buffer, "PNG")
    return {"name": scene, "matchers": names, "png": buffer.getvalue()}


def _both_images(run: RunDirectory, matcher: str, scene: str) -> Image.Image:
    """Return disparity and error side by side."""
    stem = f"pictures/{matcher}/{scene}"
    found = Image.open(run.path(f"{stem}_disparity.png"))
    # The error has the size of the ground truth, which is that of no or every matcher's result.
    error = Image.open(run.path(f"{stem}_error.png"))
    width = min(_WIDTH_PX, error.width)
    size = (width, max(1, round(error.height * width / error.width)))
    nearest = Image.Resampling.NEAREST
    return _joined([found.resize(size, nearest), error.resize(size, nearest)], down=False)


def _joined(images: list[Image.Image], *, down: bool) -> Image.Image:
    """Return images of one size below or beside each other, with white gaps."""
    width, height = images[0].size
    step = (0, height + _GAP_PX) if down else (width + _GAP_PX, 0)
    last = len(images) - 1
    whole = Image.new("RGB", (width + last * step[0], height + last * step[1]), "white")
    for n, image in enumerate(images):
        whole.paste(image, (n * step[0], n * step[1]))
    return whole
