"""The report of a pair, and figures of pairs and of the results for their pixels, as PNG."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from recon.core.text import counted
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    PointCloud,
    Rectified,
    RectifiedCamera,
    TriangleMesh,
)
from recon.core.values.arrays import Bool, UInt8
from recon.core.values.camera import depth_from_disparity, disparity_from_depth
from recon.evaluation.disparity import Kind
from recon.evaluation.pair_summary import DisparitySummary, PairSummary
from recon.io.images.image import write_image
from recon.report import style
from recon.report.page import write_page
from recon.report.scene import T_UPRIGHT_CAMERA, Json, Scene, plot_scene
from recon.run.directory import RunDirectory
from recon.stereo.frame import StereoSettings


@dataclass(frozen=True, eq=False)
class PairResult:
    """Results of a run, from which its report is made."""

    name: str  # display name of the pair
    config: StereoSettings  # the configuration
    pair: Rectified  # the rectified images
    disparity: Disparity  # their disparity
    summary: DisparitySummary | PairSummary
    #: The points in camera axes, or None if only the disparity was requested.
    cloud: PointCloud | None = None
    mesh: TriangleMesh | None = None  # the surface in camera axes, or None
    truth: DisparityTruth | None = None  # true disparity, or None
    metrics: DisparityMetrics | None = None  # errors against it, or None
    #: Errors of measured and of inferred pixels alone, as far as there are such.
    by_kind: Mapping[Kind, DisparityMetrics] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # problems that did not stop the run

    def __repr__(self) -> str:
        parts = (self.disparity, self.cloud, self.mesh)
        made = ", ".join(repr(part) for part in parts if part is not None)
        return f"PairRun({self.name!r}, {made}, {counted(len(self.warnings), 'warning')})"


def write_pair_page(result: PairResult, run: RunDirectory) -> None:
    """Write ``report.html`` of a pair, and its results as colour images."""
    write_disparity_images(result, run)
    write_page("pair", run, result.summary.to_json(), **pair_content(result))


def write_disparity_images(result: PairResult, run: RunDirectory) -> None:
    """Write measured disparity, its confidence, and the reasons of a pair as colour images."""
    measured = result.disparity.only_measured()
    for name, image in (
        ("disparity", style.colour_disparity(measured.values)),
        ("confidence", style.colour_confidence(measured.confidence)),
        ("reason", style.colour_reasons(result.disparity.reason)),
    ):
        write_image(run.path(f"disparity/{name}_colour.png"), image)


def pair_content(result: PairResult) -> Json:
    """Return what the page of a pair shows: disparity, accuracy and 3-D view."""
    values, truth, error = result.disparity.values, result.truth, None
    if truth is not None and truth.values.shape == values.shape:
        error = error_figure(np.abs(values - truth.values), result.disparity.inferred)
    depth_m = depth_from_disparity(values, result.pair.camera)
    known = depth_m[np.isfinite(depth_m)]
    far = float(np.median(known)) if known.size else 1.0
    # From behind, left of and above the camera, depth is visible.
    eye_m = (-0.1 * far, 0.25 * far, 0.25 * far)
    return {
        "run": result,
        "result": stereo_figures(result.pair, result.disparity),
        "error": error,
        "limit_px": ERROR_LIMIT_PX,
        "errors": _error_rows(result),
        "view": plot_scene(Scene(T_UPRIGHT_CAMERA, result.cloud, result.mesh, eye_m=eye_m)),
    }


def _error_rows(result: PairResult) -> list[tuple[str, ...]]:
    """Return the table of errors, its head first: of all pixels, and of each of two kinds alone."""
    if result.metrics is None:
        return []
    shown = {"all": result.metrics} | ({**result.by_kind} if "inferred" in result.by_kind else {})
    found = [*shown.values()]
    bad = {f"bad {x:g}: off by more than {x:g} px": x for x in result.metrics.bad}
    return [
        ("figure", *shown),
        *((name, *(f"{one.bad[x]:.2f} %" for one in found)) for name, x in bad.items()),
        ("without a value", *(f"{one.invalid:.2f} %" for one in found)),
        ("mean absolute error", *(f"{one.avgerr_px:.3f} px" for one in found)),
        ("root mean square error", *(f"{one.rms_px:.3f} px" for one in found)),
        ("pixels compared", *(f"{one.pixels:,}" for one in found)),
    ]


ERROR_LIMIT_PX = 4.0  # error of the last colour: the largest threshold of Middlebury's table
_BELOW_IN = 1.0  # strip below an image: axis label and ticks, colour bar, and depths above it
_BAR_BOTTOM_IN, _BAR_IN = 0.5, 0.16
_WIDE_ASPECT = 2.0
_LABEL_ROOM = 0.1  # fraction of the length of a scale: "0.45 m" below a narrow image
_FARTHEST_MARK_M = 1000.0
# Ticks of a depth scale, the roundest first; the others fill the remaining space.
_DEPTH_STEPS = ((1.0, 2.0, 5.0), (3.0, 4.0, 6.0, 8.0), (1.5, 2.5, 3.5, 4.5, 7.0, 9.0))


def is_wide(shape: tuple[int, ...]) -> bool:
    """Return whether images of this shape (H, W, …) need the whole width of a page."""
    return shape[1] >= _WIDE_ASPECT * shape[0]


def stereo_figures(pair: Rectified, disparity: Disparity) -> dict[str, Any]:
    """Draw a pair and the results for its pixels; also return what their captions need."""
    depth_m = depth_from_disparity(disparity.values, pair.camera)
    return {
        "pair": pair_figure(pair),
        "disparity": disparity_figure(disparity, pair.camera),
        "depth": depth_figure(depth_m, disparity.inferred),
        "reasons": reasons_figure(disparity),
        "confidence": confidence_figure(disparity),
        "valid_percent": float(100 * disparity.measured.mean()),
        "inferred_percent": float(100 * disparity.inferred.mean()),
        "wide": is_wide(disparity.values.shape),
    }


@style.styled
def pair_figure(pair: Rectified) -> bytes:
    """Draw the rectified images: stacked if they are wide, else side by side."""
    (height, width), views = pair.left.shape, pair.views
    rows, columns = (len(views), 1) if is_wide(pair.left.shape) else (1, len(views))
    height_in = (style.WIDE_IN / columns * height / width + 0.3) * rows
    figure, axes = style.subplots(style.WIDE_IN, height_in, rows, columns, squeeze=False)
    sides = ("left", "right")[: len(views)]
    for below, side, (_, image) in zip(axes.flat, sides, views, strict=True):
        style.show_image(below, image, f"{side.capitalize()}, rectified")
    grey = " and ".join(f"{grey.mean():.0f}" for grey, _ in views)
    size = f"{width} by {height} pixels, with mean grey levels of {grey}"
    return style.to_png(figure, f"{' and '.join(sides).capitalize()} image, {size}")


@style.styled
def disparity_figure(disparity: Disparity, camera: RectifiedCamera) -> bytes:
    """Draw the disparity map, with scales in pixels below it and in metres of depth above that."""
    limits = style.value_range(disparity.values)
    figure = _image(style.colour_disparity(disparity.values, limits), disparity.inferred)
    bar = _colour_bar(figure, style.DISPARITY_SCALE, limits, "disparity in pixels")
    _mark_depths(bar, limits, camera)
    ratios = (100 * kind.mean() for kind in (disparity.measured, disparity.inferred))
    seen = "Disparities: {}; {:.1f} % measured, {:.1f} % inferred"
    return style.to_png(figure, seen.format(style.spread(disparity.values, " px"), *ratios))


@style.styled
def depth_figure(depth_m: NDArray[Any], inferred: Bool | None = None) -> bytes:
    """Draw a depth map (H, W) in metres, NaN = unknown; the scale is logarithmic, near is red."""
    known_m = np.where(depth_m > 0, depth_m, np.nan)
    low, high = style.value_range(known_m)
    low = max(low, 1e-3)
    high = max(high, low * 1.01)
    limits = (math.log(low), math.log(high))
    # Reversed, so that near has the same colour as in the disparity map.
    scale = f"{style.DISPARITY_SCALE}_r"
    figure = _image(style.colour_values(np.log(known_m), scale, limits), inferred)
    bar = _colour_bar(figure, scale, limits, "depth in metres (logarithmic)")
    depths = depth_marks(low, high, math.log, limits)
    bar.set_xticks(np.log(depths).tolist(), [f"{depth:g}" for depth in depths])
    return style.to_png(figure, f"Depths: {style.spread(known_m, ' m')}")


@style.styled
def confidence_figure(disparity: Disparity) -> bytes:
    """Draw the confidence of each match that was measured, from 0 to 1."""
    sure = disparity.only_measured().confidence
    figure = _image(style.colour_confidence(sure))
    _colour_bar(figure, style.CONFIDENCE_SCALE, (0.0, 1.0), "confidence (dark: not measured)")
    matched = sure[sure > 0]
    return style.to_png(figure, f"Confidence of the matches: {style.spread(matched)}")


@style.styled
def error_figure(error_px: NDArray[Any], inferred: Bool | None = None) -> bytes:
    """Draw the absolute disparity error of each pixel; NaN = not compared."""
    figure = _image(style.colour_error(error_px, ERROR_LIMIT_PX), inferred)
    label = "absolute disparity error in pixels (dark: not compared)"
    _colour_bar(figure, style.ERROR_SCALE, (0.0, ERROR_LIMIT_PX), label, extend="max")
    return style.to_png(figure, f"Disparity errors: {style.spread(error_px, ' px')}")


@style.styled
def reasons_figure(disparity: Disparity) -> bytes:
    """Draw why each pixel has a disparity or not, and the fraction of each reason."""
    figure = _image(style.colour_reasons(disparity.reason))
    ratios = disparity.reason_ratios
    labels = [f"{style.REASON_LABELS[reason]} {100 * ratios[reason]:.1f} %" for reason in ratios]
    handles = [*map(style.colour_key, labels, map(style.REASON_COLOURS.__getitem__, ratios))]
    columns = 4 if is_wide(disparity.reason.shape) else 3
    middle = 0.5 * _BELOW_IN / figure.get_size_inches()[1]
    figure.legend(handles=handles, loc="center", ncols=columns, bbox_to_anchor=(0.5, middle))
    return style.to_png(figure, f"Of all pixels: {', '.join(labels)}")


def depth_marks(
    low_m: float, high_m: float, place: Callable[[float], float], limits: tuple[float, float]
) -> list[float]:
    """Return depths > 0 to mark on a scale with these ends, as many as its labels have room for."""
    powers = range(math.floor(math.log10(low_m)), math.ceil(math.log10(high_m)) + 1)
    choices = [step * 10.0**power for tier in _DEPTH_STEPS for power in powers for step in tier]
    if low_m < high_m < 2.0 * low_m:  # hardly any of these lies in between
        whole_m = 10.0 ** math.floor(math.log10(high_m - low_m))
        for step_m in (whole_m, 0.5 * whole_m, 0.2 * whole_m):
            steps = range(math.ceil(low_m / step_m), int(high_m / step_m) + 1)
            choices += [step_m * n for n in steps]
    room = _LABEL_ROOM * (limits[1] - limits[0])
    marks: dict[float, float] = {}
    for depth in choices:
        there = place(depth)
        free = all(abs(there - other) >= room for other in marks.values())
        if low_m <= depth <= high_m and free:
            marks[depth] = there
    return sorted(marks)


def _image(image: UInt8, inferred: Bool | None = None) -> Figure:
    """Return an image over the width of its figure, with room for a scale or legend below.

    Pixels that were inferred are hatched, and a legend on the image says so.
    """
    height, width = image.shape[:2]
    width_in = style.WIDE_IN if is_wide(image.shape) else style.HALF_IN
    height_in = width_in * height / width + _BELOW_IN
    # Layout engines ignore the ticks on the upper side of a scale.
    figure = style.bare_figure(width_in, height_in)
    axes = figure.add_axes((0.0, _BELOW_IN / height_in, 1.0, 1.0 - _BELOW_IN / height_in))
    axes.imshow(image if inferred is None else style.hatch(image, inferred), aspect="auto")
    axes.set_axis_off()
    if inferred is not None and inferred.any():
        axes.legend(handles=[style.hatch_key()], loc="lower left", frameon=True, framealpha=0.9)
    return figure


def _colour_bar(
    figure: Figure, scale: str, limits: tuple[float, float], label: str, extend: str = "neither"
) -> Axes:
    height_in = figure.get_size_inches()[1]
    axes = figure.add_axes((0.05, _BAR_BOTTOM_IN / height_in, 0.9, _BAR_IN / height_in))
    colours = ScalarMappable(Normalize(*limits), cmap=scale)
    bar = figure.colorbar(colours, cax=axes, orientation="horizontal", extend=extend, label=label)
    bar.outline.set_visible(False)
    return axes


def _mark_depths(bar: Axes, limits: tuple[float, float], camera: RectifiedCamera) -> None:
    """Mark round depths on the upper side of a horizontal disparity bar."""
    near, far = depth_from_disparity(np.asarray([limits[1], limits[0]]), camera).tolist()
    if not math.isfinite(near):
        return
    # A disparity near 0 is an unbounded depth.
    far = min(far, _FARTHEST_MARK_M) if math.isfinite(far) else _FARTHEST_MARK_M

    def place(depth_m: float) -> float:
        return float(disparity_from_depth(np.asarray(depth_m), camera))

    depths, upper = depth_marks(near, far, place, limits), bar.twiny()
    upper.set_xlim(*limits)
    upper.spines[:].set_visible(False)
    upper.set_xticks([*map(place, depths)], [f"{depth:g} m" for depth in depths])
    upper.tick_params(length=2, pad=1)
