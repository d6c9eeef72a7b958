"""The report of a calibration, and its images."""

from __future__ import annotations

import numpy as np

from recon.core.values import StereoPair
from recon.io.atomic import write_bytes
from recon.io.images.image import read_image
from recon.report.calibration_figures import (
    coverage_figure,
    depth_error_figure,
    errors_figure,
    rows_figure,
)
from recon.report.epipolar import EpipolarImage, epipolar_figure, level_lines, spread_points
from recon.report.page import write_page
from recon.rig.calibrate.quality import shared_pixels
from recon.rig.calibrate.result import CalibrationRun
from recon.run.directory import RunDirectory
from recon.stereo.rectify.epipolar import epipolar_curves
from recon.stereo.rectify.rectifier import Rectifier


def write_calibration_page(run: CalibrationRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of a calibration, and its images.

    Raises:
        OutputError: A file cannot be written.
    """
    before, after = epipolar_images(run)
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
    found = run.summary
    write_page(
        "calibration",
        directory,
        found=found,
        figures=figures,
        warnings=found["warnings"],
        verdict=found["verdict"],
        sound=found["verdict"] == "good",
    )


def epipolar_images(run: CalibrationRun) -> tuple[bytes, bytes]:
    """PNGs of the view with median error: raw with epipolar curves, rectified with rows."""
    view = run.fit.views[int(np.argsort(run.fit.errors_px.sum(axis=1))[len(run.fit.views) // 2])]
    left_px, right_px = shared_pixels(view)
    chosen = spread_points(left_px)
    pixels = (left_px[chosen], right_px[chosen])
    left, right = run.seen.pairs[view.name]
    pair = StereoPair(read_image(left), read_image(right), name=view.name)
    rig, turns = run.fit.calibration, run.turns
    curves = epipolar_curves(rig, *pixels)
    raw = epipolar_figure(
        EpipolarImage(pair.left, pixels[0], curves[0], f"Left, as recorded: {view.name}"),
        EpipolarImage(pair.right, pixels[1], curves[1], "Right, as recorded"),
    )
    rectified = Rectifier(rig, run.config.rectification).rectify(pair)
    placed = [turns.place(rig, pixels[0]), turns.place(rig, pixels[1], right=True)]
    rows = level_lines(placed[0], turns.camera.width_px)
    level = epipolar_figure(
        EpipolarImage(rectified.left, placed[0], rows, "Left, rectified"),
        EpipolarImage(rectified.right, placed[1], rows, "Right, rectified: rows of the left"),
    )
    return raw, level
