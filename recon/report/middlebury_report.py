"""The report of an evaluation on Middlebury scenes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from PIL import Image

from recon.core.values.arrays import UInt8
from recon.io.images.image import read_image
from recon.report.confidence_figures import reliability_figure, sparsification_figure
from recon.report.html import Block, FigureBlock, ReportContent, Section, TableBlock
from recon.report.middlebury_tables import report_tables, scene_names
from recon.run.directory import RunDirectory
from recon.run.machine import versions

_WIDTH_PX: Final = 300
"""Largest width of pictures in the report."""

_GAP_PX: Final = 6
_MANY_COLUMNS: Final = 7
_HOW_TO_READ: Final = (
    "bad and invalid in per cent of the pixels; avgerr, rms and a50 to a99 in pixels of the full "
    "size. nonocc: pixels that both cameras see; all: occluded ones too. dense: with holes filled; "
    "sparse: only pixels with a value. ece, ause and sigma: docs/evaluation.md."
)


def middlebury_report(
    summary: Mapping[str, Any], directory: RunDirectory, *, config: str = "", command: str = ""
) -> ReportContent:
    """Compose the report: tables, calibration of the confidences, and the maps of each scene.

    Args:
        summary: The content of ``summary.json``.
        directory: Directory with the pictures of all results.
        config: The effective configuration as text.
        command: The command line, or "".
    """
    tables = [
        TableBlock(one.title, one.rows[0], one.rows[1:], wide=len(one.rows[0]) > _MANY_COLUMNS)
        for one in report_tables(summary)
    ]
    scenes = scene_names(summary["matchers"])
    sections = (
        Section("Tables", tables, _HOW_TO_READ),
        Section("Confidence", _confidence_blocks(summary)),
        Section("Scenes", [_scene_block(name, summary, directory) for name in scenes]),
    )
    return ReportContent(
        title=f"Middlebury: {', '.join(summary['matchers'])}",
        subtitle=f"{len(scenes)} scene{'s' * (len(scenes) > 1)} of {summary['folder']}, "
        f"{summary['seconds']:.0f} s",
        command=command,
        warnings=summary["warnings"],
        figures=list(_figures(summary)),
        sections=sections,
        config=config,
        versions=versions(),
    )


def _figures(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for name, found in summary["matchers"].items():
        bad = found["weighted"]["nonocc"]["dense"]["bad"]["2"]
        yield f"{name}: bad 2, nonocc, dense", f"{bad:.1f} %"


def _confidence_blocks(summary: Mapping[str, Any]) -> list[Block]:
    rated = {
        name: found["weighted"]["confidence"]
        for name, found in summary["matchers"].items()
        if found["weighted"]["confidence"]
    }
    if not rated:
        return []
    return [
        FigureBlock(
            "Reliability",
            reliability_figure(rated),
            "A pixel is right if it is off by at most one pixel of the map. Above the dashed line, "
            "pixels are right more often than the confidence says. Matchers without a confidence "
            "are left out.",
            wide=False,
        ),
        FigureBlock(
            "Sparsification",
            sparsification_figure(rated),
            "The closer to the dotted line, the better the confidence ranks the errors.",
            wide=False,
        ),
    ]


def _scene_block(scene: str, summary: Mapping[str, Any], directory: RunDirectory) -> FigureBlock:
    """One row of pictures per matcher: its disparity and error."""
    names = [name for name, found in summary["matchers"].items() if scene in found["scenes"]]
    rows = [_both_pictures(directory, name, scene) for name in names]
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(_spaced(rows, 0), axis=0)).save(buffer, "PNG")
    caption = (
        f"From top to bottom: {', '.join(names)}. Left the disparity, right its "
        "error: blue is right, red is off by 4 full-size pixels or more, black is unknown."
    )
    return FigureBlock(scene, buffer.getvalue(), caption, wide=False)


def _both_pictures(directory: RunDirectory, matcher: str, scene: str) -> UInt8:
    """Disparity and error side by side: uint8 (H, W, 3)."""
    stem = f"pictures/{matcher}/{scene}"
    found = read_image(directory.path(f"{stem}_disparity.png"))
    # The error has the size of the ground truth, which is that of no or every matcher's result.
    error = read_image(directory.path(f"{stem}_error.png"))
    width = min(_WIDTH_PX, error.shape[1])
    size = (max(1, round(error.shape[0] * width / error.shape[1])), width)
    return np.concatenate(_spaced([_sized(found, size), _sized(error, size)], 1), axis=1)


def _sized(picture: UInt8, size: tuple[int, int]) -> UInt8:
    """Resize a picture by nearest neighbour: uint8 (H, W, 3) with ``size`` rows and columns."""
    rows, columns = (
        np.arange(n) * old // n for n, old in zip(size, picture.shape[:2], strict=True)
    )
    return np.asarray(picture[np.ix_(rows, columns)])


def _spaced(pictures: list[UInt8], axis: int) -> list[UInt8]:
    """Insert a white gap between pictures."""
    shape = list(pictures[0].shape)
    shape[axis] = _GAP_PX
    gap = np.full(shape, 255, np.uint8)
    return [part for picture in pictures for part in (picture, gap)][:-1]
