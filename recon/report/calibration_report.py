"""The report of a calibration, and its pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recon.commands.config import dump_config
from recon.core.values import StereoPair
from recon.io.atomic import write_bytes, write_text
from recon.io.images.image import read_image
from recon.report.blocks import run_blocks
from recon.report.calibration_figures import (
    coverage_figure,
    depth_error_figure,
    errors_figure,
    rows_figure,
)
from recon.report.epipolar_figures import (
    EpipolarPicture,
    epipolar_figure,
    level_lines,
    spread_points,
)
from recon.report.html import FigureBlock, ReportContent, Section, TableBlock, render_html
from recon.report.present import command_line
from recon.rig.calibrate import shared_pixels
from recon.rig.calibrate.result import CalibrationRun
from recon.run.directory import RunDirectory
from recon.run.machine import versions
from recon.stereo.rectify import Rectifier, epipolar_curves


def present_calibration(run: CalibrationRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of a calibration, and its pictures.

    Raises:
        OutputError: A file cannot be written.
    """
    before, after = epipolar_pictures(run)
    figures = {
        "coverage": coverage_figure(run),
        "view_errors": errors_figure(run),
        "epipolar_raw": before,
        "epipolar_rectified": after,
        "row_errors": rows_figure(run),
        "depth_error": depth_error_figure(run),
    }
    for name, png in figures.items():
        write_bytes(directory.path(f"pictures/{name}.png"), png)
    write_text(directory.path("report.html"), render_html(_content(run, figures)))


def epipolar_pictures(run: CalibrationRun) -> tuple[bytes, bytes]:
    """PNGs of the view with median error: raw with epipolar curves, rectified with rows."""
    view = run.fit.views[int(np.argsort(run.fit.errors_px.sum(axis=1))[len(run.fit.views) // 2])]
    left_px, right_px = shared_pixels(view)
    chosen = spread_points(left_px)
    pixels = (left_px[chosen], right_px[chosen])
    left, right = run.seen.pairs[view.name]
    pair = StereoPair(read_image(left), read_image(right), name=view.name)
    curves = epipolar_curves(run.fit.calibration, *pixels)
    raw = epipolar_figure(
        EpipolarPicture(pair.left, pixels[0], curves[0], f"Left, as recorded: {view.name}"),
        EpipolarPicture(pair.right, pixels[1], curves[1], "Right, as recorded"),
    )
    rectified = Rectifier(run.fit.calibration, run.config.rectification).rectify(pair)
    width = run.turns.camera.width_px
    rig, turns = run.fit.calibration, run.turns
    placed = [turns.place(rig, pixels[0]), turns.place(rig, pixels[1], right=True)]
    rows = level_lines(placed[0], width)
    level = epipolar_figure(
        EpipolarPicture(rectified.left, placed[0], rows, "Left, rectified"),
        EpipolarPicture(rectified.right, placed[1], rows, "Right, rectified: rows of the left"),
    )
    return raw, level


def _content(run: CalibrationRun, figures: Mapping[str, bytes]) -> ReportContent:
    s = run.summary
    depth = (
        "calibration: systematic error, rms over the image. interval: its 95 % interval in the "
        "middle of the image. matching: error of a match that is off by 0.25 px."
    )
    sections = (
        Section("Fit", [
            FigureBlock("Each view", figures["view_errors"],
                        "Dashed: rms over all corners of both images."),
            FigureBlock("Where the board was", figures["coverage"],
                        "One colour per view. Where there are no corners, distortion is a guess."),
        ]),
        Section("Rectified", [
            FigureBlock("Epipolar lines, as recorded", figures["epipolar_raw"],
                        "A point in one image lies on the line of its colour in the other."),
            FigureBlock("Epipolar lines, rectified", figures["epipolar_rectified"],
                        "Rows of the left image, drawn across both."),
            FigureBlock("Row errors", figures["row_errors"],
                        "Over all corners of all views; a matcher needs less than half a pixel.",
                        wide=False),
        ]),
        Section("Expected depth error", [
            FigureBlock("Depth error", figures["depth_error"],
                        "The larger of the two lines dominates.", wide=False),
            TableBlock("Depth error in cm", ("depth", "calibration", "interval", "matching"),
                       _depth_rows(s), depth),
        ]),
        Section("Run", run_blocks(s)),
    )  # fmt: skip
    return ReportContent(
        title="Stereo calibration",
        subtitle=f"{s['board']}, {s['views_used']} of {s['views']} views, lens {s['model']}",
        command=command_line(),
        warnings=s["warnings"],
        verdict=f"Verdict: {s['verdict']}",
        sound=s["verdict"] == "good",
        figures=[
            ("Reprojection error (rms)", f"{s['stereo_rms_px']:.3f} px"),
            ("Row error, rectified", f"{s['epipolar_px']:.3f} px"),
            ("Baseline", f"{s['baseline_m']:.4g} m"),
            ("Focal length", f"{s['focal_px']:.2f} px"),
        ],
        sections=sections,
        config=dump_config(run.config, "calibrate"),
        versions=versions(),
    )


def _depth_rows(summary: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    rows = []
    for depth, error in summary["depth_error_cm"].items():
        texts = {k: "–" if v is None else f"{v:.3g}" for k, v in error.items()}
        interval = f"{texts['low']} … {texts['high']}"
        rows.append((f"{depth} m", texts["calibration"], interval, texts["matching"]))
    return rows
