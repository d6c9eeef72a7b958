"""The report of a calibration, and pairs with epipolar lines as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recon.core.values import StereoPair
from recon.core.values.arrays import Float64, UInt8
from recon.io.atomic import write_bytes
from recon.io.images.image import read_image
from recon.report.page import write_page
from recon.report.style import (
    BAD,
    ESTIMATE,
    FAINT,
    HALF_IN,
    INK,
    WIDE_IN,
    show_image,
    styled,
    to_png,
)
from recon.rig.calibrate.bootstrap import CONFIDENCE, MATCH_SIGMA_PX
from recon.rig.calibrate.result import CalibrationRun, shared_pixels
from recon.rig.rectification import RectifyRun
from recon.run.directory import RunDirectory
from recon.stereo.rectify.lens import epipolar_curves
from recon.stereo.rectify.rectifier import Rectifier

_CELLS: Final = (8, 6)


def write_calibration_page(result: CalibrationRun, run: RunDirectory) -> None:
    """Write ``report.html`` of a calibration, and its images."""
    before, after = epipolar_images(result)
    figures = {
        "coverage": coverage_figure(result),
        "view_errors": errors_figure(result),
        "epipolar_raw": before,
        "epipolar_rectified": after,
        "row_errors": rows_figure(result),
        "depth_error": depth_error_figure(result),
    }
    for name, png in figures.items():
        write_bytes(run.path(f"pictures/{name}.png"), png)
    found = result.summary
    write_page(
        "calibration",
        run,
        found=found,
        figures=figures,
        warnings=found["warnings"],
        verdict=found["verdict"],
        sound=found["verdict"] == "good",
    )


def epipolar_images(result: CalibrationRun) -> tuple[bytes, bytes]:
    """Draw the view with median error: raw with epipolar curves, rectified with rows."""
    view = result.fit.views[
        int(np.argsort(result.fit.errors_px.sum(axis=1))[len(result.fit.views) // 2])
    ]
    left_px, right_px = shared_pixels(view)
    chosen = spread_points(left_px)
    pixels = (left_px[chosen], right_px[chosen])
    left, right = result.seen.pairs[view.name]
    pair = StereoPair(read_image(left), read_image(right), name=view.name)
    rig, turns = result.fit.calibration, result.turns
    curves = epipolar_curves(rig, *pixels)
    raw = epipolar_figure(
        EpipolarImage(pair.left, pixels[0], curves[0], f"Left, as recorded: {view.name}"),
        EpipolarImage(pair.right, pixels[1], curves[1], "Right, as recorded"),
    )
    rectified = Rectifier(rig, result.config.rectification).rectify(pair)
    placed = [turns.place(rig, pixels[0]), turns.place(rig, pixels[1], right=True)]
    rows = level_lines(placed[0], turns.camera.width_px)
    level = epipolar_figure(
        EpipolarImage(rectified.left, placed[0], rows, "Left, rectified"),
        EpipolarImage(rectified.right, placed[1], rows, "Right, rectified: rows of the left"),
    )
    return raw, level


@styled
def coverage_figure(result: CalibrationRun) -> bytes:
    """Draw all corners found in both images, over the cells of the coverage measure."""
    width, height = result.seen.size_px
    figure = Figure((WIDE_IN, WIDE_IN / 2 * height / width + 0.5))
    for side, axes in enumerate(figure.subplots(1, 2)):
        name = ("left", "right")[side]
        colours = colormaps["turbo"](np.linspace(0.05, 0.95, len(result.fit.views)))
        for view, colour in zip(result.fit.views, colours, strict=True):
            axes.plot(*view.seen[side].pixels.T, ".", color=colour, markersize=3.5, alpha=0.8)
        share = result.summary[f"coverage_{name}"]
        axes.set_title(f"{name.capitalize()}: {100 * share:.0f} % of the cells")
        _frame(axes, width, height)
    return to_png(figure)


@styled
def errors_figure(result: CalibrationRun) -> bytes:
    """Draw the RMS error of each view in both images, including dropped views."""
    names = [*(view.name for view in result.fit.views), *result.fit.dropped]
    used = len(result.fit.views)
    figure = Figure((WIDE_IN, 3.4))
    axes = figure.subplots()
    place = np.arange(used)
    axes.bar(place - 0.2, result.fit.errors_px[:, 0], 0.38, label="left")
    axes.bar(place + 0.2, result.fit.errors_px[:, 1], 0.38, label="right")
    if result.fit.dropped:
        gone = np.arange(used, len(names))
        axes.bar(gone, list(result.fit.dropped.values()), 0.6, color=BAD, label="dropped")
        axes.set_yscale("log")
    axes.axhline(result.fit.rms_px, color=INK, linewidth=1, linestyle="--")
    axes.set_ylabel("rms error, px")
    axes.set_xticks(np.arange(len(names)), names, rotation=60, ha="right", fontsize=7)
    axes.legend(ncols=3)
    return to_png(figure)


@styled
def rows_figure(result: CalibrationRun) -> bytes:
    """Draw the row differences of the corners after rectification."""
    figure = Figure((HALF_IN, 3.4))
    axes = figure.subplots()
    reach = max(float(np.quantile(np.abs(result.rows_px), 0.999)), 0.05)
    axes.hist(result.rows_px, bins=list(np.linspace(-reach, reach, 61)))
    axes.axvline(0, color=INK, linewidth=1)
    axes.set(xlabel="row left − row right, px", ylabel="corners")
    return to_png(figure)


@styled
def depth_error_figure(result: CalibrationRun) -> bytes:
    """Draw the depth error by depth: from matching, and from calibration with its interval."""
    errors = result.spread.depths
    known = [each for each in errors if np.isfinite(each.calibration_m)]
    known_m = [each.depth_m for each in known]
    matching = [100 * each.matching_m for each in errors]
    calibration = [100 * each.calibration_m for each in known]
    reach = [100 * max(abs(each.low_m), abs(each.high_m)) for each in known]
    figure = Figure((HALF_IN, 3.4))
    axes = figure.subplots()
    axes.plot(
        [each.depth_m for each in errors],
        matching,
        "o-",
        color=FAINT,
        label=f"matching to {MATCH_SIGMA_PX:g} px",
    )
    axes.plot(known_m, calibration, "o-", color=ESTIMATE, label="calibration, over the image")
    label = f"{100 * CONFIDENCE:.0f} % interval, middle of the image"
    axes.fill_between(known_m, 1e-3, reach, color=ESTIMATE, alpha=0.15, linewidth=0, label=label)
    axes.set(xscale="log", yscale="log", xlabel="depth, m", ylabel="depth error, cm")
    axes.set_ylim(bottom=max(min([*matching, *calibration]) / 3, 1e-3))
    axes.set_xticks([each.depth_m for each in errors], [f"{each.depth_m:g}" for each in errors])
    axes.minorticks_off()
    axes.legend(fontsize=8)
    return to_png(figure)


def _frame(axes: Axes, width: int, height: int) -> None:
    """Draw the cells of an image, and its border."""
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.set_xticks(np.linspace(0, width, _CELLS[0] + 1)[1:-1], [])
    axes.set_yticks(np.linspace(0, height, _CELLS[1] + 1)[1:-1], [])
    axes.spines[:].set(visible=True, color=FAINT)


@dataclass(frozen=True, eq=False)
class EpipolarImage:
    """One image with points and the epipolar lines they should lie on.

    Attributes:
        image: uint8 (H, W) or (H, W, 3).
        pixels: float64 (N, 2), the points.
        lines: One curve (M, 2) per point; NaN = outside the image.
        title: Title of the figure.
    """

    image: UInt8
    pixels: Float64
    lines: Sequence[Float64]
    title: str


def write_epipolar_images(result: RectifyRun, run: RunDirectory) -> None:
    """Write ``pictures/epipolar_raw.png`` and ``pictures/epipolar_rectified.png``."""
    chosen = spread_points(result.raw_px[0], 12)
    rows = level_lines(result.rectified_px[0][chosen], result.rectified[0].shape[1])
    raw = (result.pair.left, result.pair.right)
    titles = ("Left, rectified", "Right, rectified: rows of the left")
    before = [
        EpipolarImage(
            raw[n],
            result.raw_px[n][chosen],
            [result.raw_lines[n][line] for line in chosen],
            f"{('Left', 'Right')[n]}, as recorded",
        )
        for n in (0, 1)
    ]
    after = [
        EpipolarImage(result.rectified[n], result.rectified_px[n][chosen], rows, titles[n])
        for n in (0, 1)
    ]
    write_bytes(run.path("pictures/epipolar_raw.png"), epipolar_figure(*before))
    write_bytes(run.path("pictures/epipolar_rectified.png"), epipolar_figure(*after))


def level_lines(pixels: Float64, width_px: int) -> list[Float64]:
    """Return the rows of the points, as lines across the image."""
    return [np.array([[0.0, y], [width_px - 1.0, y]]) for _, y in pixels]


@styled
def epipolar_figure(left: EpipolarImage, right: EpipolarImage) -> bytes:
    """Draw both images side by side; a point and its line have the same colour in both."""
    height, width = left.image.shape[:2]
    figure = Figure((WIDE_IN, WIDE_IN / 2 * height / width + 0.4))
    for axes, image in zip(figure.subplots(1, 2), (left, right), strict=True):
        _draw(axes, image)
    return to_png(figure)


def spread_points(pixels: Float64, count: int = 10) -> Float64:
    """Return int64 (M,), indices of at most ``count`` points, evenly spread by row."""
    order = np.argsort(pixels[:, 1])
    picked = np.unique(np.linspace(0, len(order) - 1, min(count, len(order))).astype(int))
    return np.asarray(order[picked])


def _draw(axes: Axes, drawn: EpipolarImage) -> None:
    height, width = drawn.image.shape[:2]
    show_image(axes, drawn.image, drawn.title)
    colours = colormaps["turbo"](np.linspace(0.08, 0.92, max(len(drawn.pixels), 1)))
    for pixel, line, colour in zip(drawn.pixels, drawn.lines, colours, strict=True):
        axes.plot(*line.T, color=colour, linewidth=1.1)
        axes.plot(*pixel, "o", markersize=5, color=colour, markeredgecolor="white")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
