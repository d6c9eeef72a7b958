"""The report of a calibration, and pairs with epipolar lines as pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib import colormaps

from recon.core.text import counted
from recon.core.values import StereoPair
from recon.core.values.arrays import Float64
from recon.io.atomic import write_bytes
from recon.io.images.image import read_image
from recon.report import style
from recon.report.page import run_section, write_page
from recon.report.sections import Image, Page, Section, Table, known, row_of
from recon.rig.calibrate.stereo import CELLS, CONFIDENCE, MATCH_SIGMA_PX
from recon.rig.calibrate.verdict import CalibrationResult, shared_pixels
from recon.rig.rectification import RectifyResult
from recon.run.directory import RunDirectory
from recon.stereo.rectify.lens import epipolar_curves
from recon.stereo.rectify.rectifier import Rectifier

Sides = Sequence[Any]  # one value for the left image, one for the right
_DEPTH_ERRORS: Final = ("calibration", "low", "high", "matching")


def write_calibration_page(result: CalibrationResult, run: RunDirectory) -> None:
    """Write ``report.html`` of a calibration, and its images."""
    found, drawn = result.summary.to_json(), {
        "coverage": coverage_figure(result),
        "view_errors": errors_figure(result),
        **_epipolar_pictures(result),
        "epipolar_errors": epipolar_figure(result),
        "depth_error": depth_error_figure(result),
    }  # fmt: skip
    _write_pictures(drawn, run)
    columns = [("{:.3g}", name) for name in _DEPTH_ERRORS]
    rows = [row_of(f"{z} m", error, columns) for z, error in found["depth_error_cm"].items()]
    sections = [
        Section("Fit", [
            Image("Each view", drawn["view_errors"],
                  "Dashed: rms over all corners of both images."),
            Image("Where the board was", drawn["coverage"],
                  "One colour per view. Where there are no corners, distortion is a guess."),
        ]),
        Section("Rectified", [
            Image("Epipolar lines, as recorded", drawn["epipolar_raw"],
                  "A point in one image lies on the line of its colour in the other."),
            Image("Epipolar lines, rectified", drawn["epipolar_rectified"],
                  "Rows of the left image, drawn across both."),
            Image("Epipolar errors", drawn["epipolar_errors"],
                  "Over all corners of all views; a matcher needs less than half a pixel."),
        ]),
        Section("Expected depth error", [
            Image("Depth error", drawn["depth_error"],
                  "The larger of the two lines dominates."),
            Table("Depth error in cm", ("depth", *_DEPTH_ERRORS), rows, caption=(
                "calibration: systematic error, rms over the image. low, high: its "
                f"{100 * CONFIDENCE:.0f} % interval in the middle of the image. matching: error "
                f"of a match that is off by {MATCH_SIGMA_PX:g} px.")),
        ]),
        run_section(found),
    ]  # fmt: skip
    figures = [
        ("Reprojection error (RMS)", known("{:.3f} px", found["stereo_rms_px"])),
        ("Epipolar error, rectified", known("{:.3f} px", found["epipolar_px"])),
        ("Baseline", known("{:.4g} m", found["baseline_m"])),
        ("Focal length", known("{:.2f} px", found["focal_px"])),
    ]
    views = f"{found['views_used']} of {counted(found['views'], 'view')}"
    subtitle = f"{found['board']}, {views}, lens {found['model']}"
    write_page(Page("Stereo calibration", subtitle, figures, sections, found), run)


def _epipolar_pictures(result: CalibrationResult) -> dict[str, bytes]:
    """Draw the view with median error."""
    fit, turns = result.fit, result.turns
    view = fit.views[int(np.argsort(fit.errors_px.sum(axis=1))[len(fit.views) // 2])]
    left_px, right_px = shared_pixels(view)
    chosen = spread_points(left_px)
    pixels = (left_px[chosen], right_px[chosen])
    left, right = (read_image(file) for file in result.seen.pairs[view.name])
    rectifier = Rectifier(fit.calibration, result.config.rectification)
    level = rectifier.rectify(StereoPair(left, right, name=view.name))
    level_px = [turns.place(fit.calibration, pixels[n], right=n == 1) for n in (0, 1)]
    raw = ((left, right), pixels, epipolar_curves(fit.calibration, *pixels))
    return epipolar_pictures(raw, ((level.left, level.right), level_px), f": {view.name}")


@style.styled
def coverage_figure(result: CalibrationResult) -> bytes:
    """Draw all corners found in both images, over the cells of the coverage measure."""
    width, height = result.seen.size_px
    height_in = style.WIDE_IN / 2 * height / width + 0.5
    figures = result.summary.to_json()
    figure, both = style.subplots(style.WIDE_IN, height_in, columns=2)
    for side, (name, axes) in enumerate(zip(("left", "right"), both, strict=True)):
        colours = colormaps["turbo"](np.linspace(0.05, 0.95, len(result.fit.views)))
        for view, colour in zip(result.fit.views, colours, strict=True):
            axes.plot(*view.seen[side].pixels.T, ".", color=colour, markersize=3.5, alpha=0.8)
        ratio = figures[f"coverage_{name}"]
        axes.set_title(f"{name.capitalize()}: {100 * ratio:.0f} % of the cells")
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
        axes.set_xticks(np.linspace(0, width, CELLS[0] + 1)[1:-1], [])
        axes.set_yticks(np.linspace(0, height, CELLS[1] + 1)[1:-1], [])
        axes.spines[:].set(visible=True, color=style.FAINT)
    covered = "; ".join(axes.get_title() for axes in both)
    return style.to_png(figure, f"Corners that were found. {covered}")


@style.styled
def errors_figure(result: CalibrationResult) -> bytes:
    """Draw the RMS error of each view in both images, including dropped views."""
    fit = result.fit
    names = [style.label_of(name) for name in (*(view.name for view in fit.views), *fit.dropped)]
    figure, axes = style.subplots(style.WIDE_IN, 3.4)
    place = np.arange(len(fit.views))
    axes.bar(place - 0.2, fit.errors_px[:, 0], 0.38, label="left")
    axes.bar(place + 0.2, fit.errors_px[:, 1], 0.38, label="right")
    if fit.dropped:
        gone = np.arange(len(fit.views), len(names))
        axes.bar(gone, list(fit.dropped.values()), 0.6, color=style.BAD, label="dropped")
        axes.set_yscale("log")
    axes.axhline(fit.rms_px, color=style.INK, linewidth=1, linestyle="--")
    axes.set_ylabel("rms error, px")
    axes.set_xticks(np.arange(len(names)), names, rotation=60, ha="right", fontsize=7)
    axes.legend(ncols=3)
    each = f"Rms of a view: {style.spread(fit.errors_px, ' px')}"
    return style.to_png(figure, f"{each}; {fit.rms_px:.3f} px of all")


@style.styled
def epipolar_figure(result: CalibrationResult) -> bytes:
    """Draw the row differences of the corners after rectification."""
    figure, axes = style.subplots(style.HALF_IN, 3.4)
    reach = max(float(np.quantile(np.abs(result.epipolar_error_px), 0.999)), 0.05)
    axes.hist(result.epipolar_error_px, bins=list(np.linspace(-reach, reach, 61)))
    axes.axvline(0, color=style.INK, linewidth=1)
    axes.set(xlabel="row left − row right, px", ylabel="corners")
    return style.to_png(figure, f"Epipolar errors: {style.spread(result.epipolar_error_px, ' px')}")


@style.styled
def depth_error_figure(result: CalibrationResult) -> bytes:
    """Draw the depth error by depth: from matching, and from calibration with its interval."""
    errors = result.spread.depths
    known = [each for each in errors if np.isfinite(each.calibration_m)]
    known_m = [each.depth_m for each in known]
    matching = [100 * each.matching_m for each in errors]
    calibration = [100 * each.calibration_m for each in known]
    reach = [100 * max(abs(each.low_m), abs(each.high_m)) for each in known]
    depths_m, label = [each.depth_m for each in errors], f"matching to {MATCH_SIGMA_PX:g} px"
    figure, axes = style.subplots(style.HALF_IN, 3.4)
    axes.plot(depths_m, matching, "o-", color=style.FAINT, label=label)
    axes.plot(known_m, calibration, "o-", color=style.ESTIMATE, label="calibration, over the image")
    label = f"{100 * CONFIDENCE:.0f} % interval, middle of the image"
    look = {"color": style.ESTIMATE, "alpha": 0.15, "linewidth": 0}
    axes.fill_between(known_m, 1e-3, reach, label=label, **look)
    axes.set(xscale="log", yscale="log", xlabel="depth, m", ylabel="depth error, cm")
    axes.set_ylim(bottom=max(min([*matching, *calibration]) / 3, 1e-3))
    axes.set_xticks(depths_m, [f"{depth_m:g}" for depth_m in depths_m])
    axes.minorticks_off()
    axes.legend(fontsize=8)
    return style.to_png(figure)


def write_epipolar_images(result: RectifyResult, run: RunDirectory) -> None:
    """Write ``pictures/epipolar_raw.png`` and ``pictures/epipolar_rectified.png``."""
    chosen = spread_points(result.raw_px[0], 12)
    lines = [[lines[n] for n in chosen] for lines in result.raw_lines]
    raw = ((result.pair.left, result.pair.right), [px[chosen] for px in result.raw_px], lines)
    rectified = (result.rectified, [px[chosen] for px in result.rectified_px])
    _write_pictures(epipolar_pictures(raw, rectified), run)


def _write_pictures(pictures: Mapping[str, bytes], run: RunDirectory) -> None:
    for name, png in pictures.items():
        write_bytes(run.path(f"pictures/{name}.png"), png)


def spread_points(pixels: Float64, count: int = 10) -> Float64:
    """Return int64 (M,), indices of at most ``count`` points, evenly spread by row."""
    order = np.argsort(pixels[:, 1])
    picked = np.unique(np.linspace(0, len(order) - 1, min(count, len(order))).astype(int))
    return np.asarray(order[picked])


def epipolar_pictures(
    raw: tuple[Sides, Sides, Sides], rectified: tuple[Sides, Sides], name: str = ""
) -> dict[str, bytes]:
    """Draw a pair with epipolar lines as recorded, and rectified with rows of the left image.

    ``raw``: images, points (N, 2) and a line (M, 2) for each; ``rectified``: images and points.
    """
    images, pixels = rectified
    right = images[0].shape[1] - 1.0
    rows = [np.array([[0.0, y], [right, y]]) for _, y in pixels[0]]
    titles = (f"Left, as recorded{name}", "Right, as recorded")
    level = ("Left, rectified", "Right, rectified: rows of the left")
    return {
        "epipolar_raw": _side_by_side(*raw, titles),
        "epipolar_rectified": _side_by_side(images, pixels, (rows, rows), level),
    }


@style.styled
def _side_by_side(images: Sides, pixels: Sides, lines: Sides, titles: Sides) -> bytes:
    """Draw both images; a point and its line have the same colour in both."""
    height, width = images[0].shape[:2]
    height_in = style.WIDE_IN / 2 * height / width + 0.4
    figure, both = style.subplots(style.WIDE_IN, height_in, columns=2)
    for n, axes in enumerate(both):
        style.show_image(axes, images[n], titles[n])
        colours = colormaps["turbo"](np.linspace(0.08, 0.92, max(len(pixels[n]), 1)))
        for pixel, line, colour in zip(pixels[n], lines[n], colours, strict=True):
            axes.plot(*line.T, color=colour, linewidth=1.1)
            axes.plot(*pixel, "o", markersize=5, color=colour, markeredgecolor="white")
        height, width = images[n].shape[:2]
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    return style.to_png(figure, f"{'; '.join(titles)}; with the lines of some points")
