"""Tables and pictures of an evaluation on Middlebury scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from recon.evaluation.middlebury.bench import SceneResult
from recon.io.atomic import write_text
from recon.io.images.image import write_image
from recon.report.colour import colour_disparity, colour_error, value_range
from recon.report.html import render_html
from recon.report.middlebury_report import middlebury_report
from recon.report.middlebury_tables import (
    csv_table,
    latex_tables,
    markdown_tables,
    text_tables,
)
from recon.report.present import command_line
from recon.run.directory import RunDirectory

ERROR_LIMIT_PX: Final = 4.0
"""Error of the last colour, in full-size pixels: the largest threshold of the table."""


def present_middlebury(summary: Mapping[str, Any], directory: RunDirectory) -> None:
    """Write the tables as text, Markdown, LaTeX and CSV, and ``report.html``.

    Raises:
        OutputError: A file cannot be written.
    """
    write_text(directory.path("tables.txt"), text_tables(summary))
    write_text(directory.path("tables.md"), markdown_tables(summary))
    write_text(directory.path("tables.tex"), latex_tables(summary))
    write_text(directory.path("figures.csv"), csv_table(summary))
    config = directory.path("config.yaml").read_text(encoding="utf-8")
    content = middlebury_report(summary, directory, config=config, command=command_line())
    write_text(directory.path("report.html"), render_html(content))


def draw_result(result: SceneResult, directory: RunDirectory) -> None:
    """Write the disparity and the error of a result as colour images.

    In the error, blue is correct, red is wrong by `ERROR_LIMIT_PX` full-size pixels or more, and
    dark is unknown ground truth; holes are filled. Disparity colours span the range of the truth.

    Raises:
        OutputError: A file cannot be written.
    """
    scale = round(4 * result.values.shape[1] / result.scene.truth.values.shape[1]) / 4
    low, high = value_range(result.scene.truth.values)
    pictures = {
        "disparity": colour_disparity(result.values, low * scale, high * scale),
        "error": colour_error(result.error_px(), ERROR_LIMIT_PX),
    }
    for name, picture in pictures.items():
        path = directory.path(f"pictures/{result.matcher}/{result.scene.name}_{name}.png")
        write_image(path, picture)
