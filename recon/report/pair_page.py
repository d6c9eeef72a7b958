"""The report of a pair; the section and the figures of a pair and of the results for its pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from recon.core.text import counted, metres
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
from recon.core.values.camera import depth_from_disparity
from recon.evaluation.disparity import Kind
from recon.evaluation.pair_summary import DisparitySummary, PairSummary
from recon.io.images.image import write_image
from recon.report import style
from recon.report.page import last_part, run_figures, run_section, write_page
from recon.report.scene import upright_scene
from recon.report.sections import Block, Image, Page, Section, Table, View3D, known
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
    write_page(pair_page(result), run)


def write_disparity_images(result: PairResult, run: RunDirectory) -> None:
    """Write measured disparity, its confidence, and the reasons of a pair as colour images."""
    measured = result.disparity.only_measured()
    for name, image in (
        ("disparity", style.colour_disparity(measured.values)),
        ("confidence", style.colour_confidence(measured.confidence)),
        ("reason", style.colour_reasons(result.disparity.reason)),
    ):
        write_image(run.path(f"disparity/{name}_colour.png"), image)


def pair_page(result: PairResult) -> Page:
    """Return the page of a pair: disparity, accuracy and 3-D view."""
    camera, found, disparity = result.pair.camera, result.summary.to_json(), result.disparity
    baseline = f"baseline {camera.baseline_m:.4g} m"
    if found.get("up_to_scale"):
        baseline = "baseline unknown: every m in this report is one baseline"
    subtitle = (
        f"{camera.width_px} × {camera.height_px} px, focal length {camera.focal_px:.1f} px "
        f"({camera.field_of_view_deg:.0f}° wide), {baseline}, doffs {camera.doffs_px:.4g} px"
    )
    measured, inferred = (100 * kind.mean() for kind in (disparity.measured, disparity.inferred))
    coverage = found.get("mesh_coverage")
    figures = [
        ("Pixels measured", f"{measured:.1f} %"),
        ("Pixels inferred", f"{inferred:.1f} %" if inferred else ""),
        *_error_figures(result),
        *run_figures(found),
        ("Points", known("{:,}", found.get("points"))),
        ("Triangles", known("{:,}", found.get("faces") or None)),
        ("Points on the mesh", known("{:.1f} %", None if coverage is None else 100 * coverage)),
    ]
    network = [(name, str(value)) for name, value in (found.get("network") or {}).items()]
    stereo = stereo_blocks(result.pair, disparity)
    sections = [
        Section("Disparity", [*stereo, Table("Network", ("what", "value"), network)]),
        Section("Against the truth", _error_blocks(result)),
        Section("Cloud", [_view(result)]),
        run_section(found),
    ]
    title = f"Stereo pair {last_part(result.name)}"
    return Page(title, subtitle, figures, sections, found)


def _error_figures(result: PairResult) -> list[tuple[str, str]]:
    if (metrics := result.metrics) is None:
        return []
    of = ", measured and inferred" if "inferred" in result.by_kind else ""
    bad = [(f"Bad {x:g}: off by more than {x:g} px{of}", y) for x, y in metrics.bad.items()]
    mean = f"{metrics.avgerr_px:.2f} px"
    return [(f"Mean error{of}", mean), *((label, f"{percent:.1f} %") for label, percent in bad)]


def _error_blocks(result: PairResult) -> list[Block]:
    """Return the errors as a picture and a table: of all pixels, and of each of two kinds alone."""
    if result.truth is None or result.metrics is None:
        return []
    values, truth, drawn = result.disparity.values, result.truth.values, None
    if truth.shape == values.shape:
        drawn = error_figure(np.abs(values - truth), result.disparity.inferred)
    both = "inferred" in result.by_kind
    shown = {"all": result.metrics} | ({**result.by_kind} if both else {})
    of = [*shown.values()]
    rows = [
        *((f"bad {x:g}: off by more than {x:g} px", *(f"{one.bad[x]:.2f} %" for one in of))
          for x in result.metrics.bad),
        ("without a value", *(f"{one.invalid:.2f} %" for one in of)),
        ("mean absolute error", *(f"{one.avgerr_px:.3f} px" for one in of)),
        ("root mean square error", *(f"{one.rms_px:.3f} px" for one in of)),
        ("pixels compared", *(f"{one.pixels:,}" for one in of)),
    ]  # fmt: skip
    note = (
        "All: of the pixels whose truth is known, those without a value too, which are not bad. "
        "Measured and inferred: of such pixels alone."
    )
    return [
        Image("Disparity error", drawn, ERROR_CAPTION),
        Table("Disparity against truth", ("figure", *shown), rows, caption=note if both else ""),
    ]


def _view(result: PairResult) -> View3D:
    depth_m = depth_from_disparity(result.disparity.values, result.pair.camera)
    known_m = depth_m[np.isfinite(depth_m)]
    far = float(np.median(known_m)) if known_m.size else 1.0
    # From behind, left of and above the camera, depth is visible.
    scene = upright_scene(result.cloud, result.mesh, (-0.1 * far, 0.25 * far, 0.25 * far))
    caption = "Seen from the left camera, turned so that z is up."
    if count := result.summary.to_json().get("inferred_points"):
        caption += f" {count:,} of the points are inferred."
    elif result.disparity.inferred.any():
        caption += " Of measured pixels alone: --set cloud.inferred=true has those inferred, too."
    return View3D("In 3-D", scene, caption)


ERROR_LIMIT_PX = 4.0  # error of the last colour: the largest threshold of Middlebury's table
ERROR_CAPTION = f"Blue is right, red is off by {ERROR_LIMIT_PX:g} pixels or more."
_BELOW_IN = 1.0  # strip below an image: axis label and ticks, colour bar, and depths above it
_BAR_BOTTOM_IN, _BAR_IN = 0.5, 0.16
_WIDE_ASPECT = 2.0


def is_wide(shape: tuple[int, ...]) -> bool:
    """Return whether images of this shape (H, W, …) need the whole width of a page."""
    return shape[1] >= _WIDE_ASPECT * shape[0]


def pair_image(pair: Rectified) -> Image:
    """Return the rectified images as a block of a page."""
    caption = "Rectified: a point is on the same row in both images."
    return Image("Input pair", pair_figure(pair), caption)


def stereo_blocks(pair: Rectified, disparity: Disparity) -> list[Block]:
    """Return a pair and the results for its pixels as blocks of a page."""
    depth_m = depth_from_disparity(disparity.values, pair.camera)
    seen = f"{100 * disparity.measured.mean():.1f} % of the pixels were measured"
    if disparity.inferred.any():
        percent = 100 * disparity.inferred.mean()
        seen += f", {percent:.1f} % inferred from planes around them (hatched)"
    return [
        pair_image(pair),
        Image("Disparity", disparity_figure(disparity, pair.camera),
              f"Red is near, blue is far, black is unknown; {seen}."),
        Image("Depth", depth_figure(depth_m, disparity.inferred),
              "The same in metres along the optical axis."),
        Image("Why pixels have no disparity", reasons_figure(disparity),
              "The first check that each pixel failed, and what fraction of all failed it."),
        Image("Confidence", confidence_figure(disparity),
              "Estimated probability that the match is correct; what was inferred is no match."),
    ]  # fmt: skip


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
    bar = _colour_bar(figure, style.DISPARITY_SCALE, Normalize(*limits), "disparity in pixels")
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
    bar = _colour_bar(figure, scale, LogNorm(low, high), "depth in metres (logarithmic)")
    bar.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    bar.xaxis.set_major_formatter("{x:g}")
    bar.minorticks_off()
    return style.to_png(figure, f"Depths: {style.spread(known_m, ' m')}")


@style.styled
def confidence_figure(disparity: Disparity) -> bytes:
    """Draw the confidence of each match that was measured, from 0 to 1."""
    sure = disparity.only_measured().confidence
    figure = _image(style.colour_confidence(sure))
    _colour_bar(figure, style.CONFIDENCE_SCALE, Normalize(0, 1), "confidence (dark: not measured)")
    matched = sure[sure > 0]
    return style.to_png(figure, f"Confidence of the matches: {style.spread(matched)}")


@style.styled
def error_figure(error_px: NDArray[Any], inferred: Bool | None = None) -> bytes:
    """Draw the absolute disparity error of each pixel; NaN = not compared."""
    figure = _image(style.colour_error(error_px, ERROR_LIMIT_PX), inferred)
    label = "absolute disparity error in pixels (dark: not compared)"
    _colour_bar(figure, style.ERROR_SCALE, Normalize(0, ERROR_LIMIT_PX), label, extend="max")
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
    figure: Figure, scale: str, norm: Normalize, label: str, extend: str = "neither"
) -> Axes:
    height_in = figure.get_size_inches()[1]
    axes = figure.add_axes((0.05, _BAR_BOTTOM_IN / height_in, 0.9, _BAR_IN / height_in))
    colours = ScalarMappable(norm, cmap=scale)
    bar = figure.colorbar(colours, cax=axes, orientation="horizontal", extend=extend, label=label)
    bar.outline.set_visible(False)
    return axes


def _mark_depths(bar: Axes, limits: tuple[float, float], camera: RectifiedCamera) -> None:
    """Say above a bar of disparities how far away they are."""
    places = [place for place in bar.get_xticks() if limits[0] <= place <= limits[1]]
    depths_m = depth_from_disparity(np.asarray(places), camera).tolist()
    labels = [metres(depth_m) if math.isfinite(depth_m) else "" for depth_m in depths_m]
    upper = bar.twiny()
    upper.set_xlim(*limits)
    upper.spines[:].set_visible(False)
    upper.set_xticks(places, labels)
    upper.tick_params(length=2, pad=1)
