"""Figures of a pair and the results for its pixels. All return PNG bytes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from recon.core.geometry.triangulation import depth_from_disparity, disparity_from_depth
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.report.canvas import FAINT, HALF_IN, INK, WIDE_IN, new_figure, style_picture, to_png
from recon.report.colour import (
    CONFIDENCE_SCALE,
    DISPARITY_SCALE,
    ERROR_SCALE,
    REASON_COLOURS,
    REASON_LABELS,
    colour_confidence,
    colour_disparity,
    colour_error,
    colour_reasons,
    colour_values,
    unit_colour,
    value_range,
)

# Height of the strip below an image: axis label and ticks, colour bar, and depths above it.
_BELOW_IN = 1.0
_BAR_BOTTOM_IN = 0.5
_BAR_IN = 0.16
_WIDE_ASPECT = 2.0
_LABEL_ROOM = 0.07  # fraction of the length of a scale
# Ticks of a depth scale, the roundest first; the others fill the remaining space.
_DEPTH_STEPS = ((1.0, 2.0, 5.0), (3.0, 4.0, 6.0, 8.0), (1.5, 2.5, 3.5, 4.5, 7.0, 9.0))


def is_wide(shape: tuple[int, ...]) -> bool:
    """Whether images of this shape (H, W, …) need the whole width of a page."""
    return shape[1] >= _WIDE_ASPECT * shape[0]


def pair_figure(pair: RectifiedPair) -> bytes:
    """Both rectified images: stacked if they are wide, else side by side."""
    height, width = pair.left.shape
    stacked = is_wide(pair.left.shape)
    columns = 1 if stacked else 2
    picture_in = WIDE_IN / columns * height / width
    figure = new_figure(WIDE_IN, (picture_in + 0.3) * (2 if stacked else 1))
    titles = ("Left, rectified", "Right, rectified")
    all_axes = figure.subplots(2 if stacked else 1, columns)
    right = pair.right if pair.right_rgb is None else pair.right_rgb
    for axes, picture, title in zip(all_axes.flat, (pair.colours, right), titles, strict=True):
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255)
        style_picture(axes, title)
    return to_png(figure)


def disparity_figure(disparity: Disparity, camera: RectifiedCamera) -> bytes:
    """The disparity map, with a scale in pixels below it and in metres of depth above that."""
    limits = value_range(disparity.values)
    figure, _ = _picture(colour_disparity(disparity.values, *limits))
    bar = _colour_bar(figure, DISPARITY_SCALE, limits)
    bar.set_label("disparity in pixels", color=INK)
    _depth_ticks(bar, limits, camera)
    return to_png(figure)


def depth_figure(depth_m: NDArray[Any]) -> bytes:
    """A depth map (H, W) in metres, NaN = unknown; the scale is logarithmic, near is red."""
    low, high = value_range(np.where(depth_m > 0, depth_m, np.nan))
    low = max(low, 1e-3)
    limits = (math.log(low), math.log(max(high, low * 1.01)))
    with np.errstate(invalid="ignore", divide="ignore"):
        logarithm = np.log(np.where(depth_m > 0, depth_m, np.nan))
    # Reversed, so that near has the same colour as in the disparity map.
    scale = f"{DISPARITY_SCALE}_r"
    figure, _ = _picture(colour_values(logarithm, scale, limits))
    bar = _colour_bar(figure, scale, limits)
    depths = depth_marks(low, high, math.log, limits)
    bar.set_ticks(list(np.log(depths)), labels=[f"{depth:g}" for depth in depths])
    bar.set_label("depth in metres (logarithmic)", color=INK)
    return to_png(figure)


def confidence_figure(disparity: Disparity) -> bytes:
    """The confidence of each match, from 0 to 1."""
    figure, _ = _picture(colour_confidence(disparity.confidence))
    bar = _colour_bar(figure, CONFIDENCE_SCALE, (0.0, 1.0))
    bar.set_label("confidence (dark: no match)", color=INK)
    return to_png(figure)


def error_figure(error_px: NDArray[Any], limit_px: float) -> bytes:
    """Absolute disparity error of each pixel, up to ``limit_px``; NaN = not compared."""
    figure, _ = _picture(colour_error(error_px, limit_px))
    bar = _colour_bar(figure, ERROR_SCALE, (0.0, limit_px), extend="max")
    bar.set_label("absolute disparity error in pixels (dark: not compared)", color=INK)
    return to_png(figure)


def reasons_figure(disparity: Disparity) -> bytes:
    """Why each pixel has a disparity or not, and the share of each reason."""
    figure, _ = _picture(colour_reasons(disparity.reason))
    handles = [
        Patch(
            facecolor=unit_colour(REASON_COLOURS[reason]),
            edgecolor=FAINT,
            linewidth=0.5,
            label=label,
        )
        for reason, label in _reason_shares(disparity.reason)
    ]
    columns = 4 if is_wide(disparity.reason.shape) else 3
    middle = 0.5 * _BELOW_IN / figure.get_size_inches()[1]
    legend = figure.legend(handles=handles, loc="center", ncols=columns, frameon=False)
    legend.set_bbox_to_anchor((0.5, middle))
    return to_png(figure)


def depth_marks(
    low_m: float, high_m: float, place: Callable[[float], float], limits: tuple[float, float]
) -> list[float]:
    """Round depths to mark on a scale, as many as there is room for labels.

    Args:
        low_m: Smallest depth on the scale, > 0.
        high_m: Largest depth.
        place: Maps a depth to its position on the scale.
        limits: Start and end of the scale.

    Returns:
        The depths, increasing; the roundest are preferred.
    """
    powers = range(math.floor(math.log10(low_m)), math.ceil(math.log10(high_m)) + 1)
    choices = [step * 10.0**power for tier in _DEPTH_STEPS for power in powers for step in tier]
    room = _LABEL_ROOM * (limits[1] - limits[0])
    marks: dict[float, float] = {}
    for depth in choices:
        there = place(depth)
        free = all(abs(there - other) >= room for other in marks.values())
        if low_m <= depth <= high_m and free:
            marks[depth] = there
    return sorted(marks)


def reason_shares(reason: UInt8) -> dict[Reason, float]:
    """Share of the pixels, in [0, 1], for each reason that occurs; the largest first."""
    counts = np.bincount(reason.ravel(), minlength=len(Reason))
    total = max(int(counts.sum()), 1)
    order = sorted(Reason, key=lambda code: -int(counts[code]))
    return {code: float(counts[code]) / total for code in order if counts[code]}


def _reason_shares(reason: UInt8) -> list[tuple[Reason, str]]:
    shares = reason_shares(reason)
    return [(code, f"{REASON_LABELS[code]} {100 * share:.1f} %") for code, share in shares.items()]


def _picture(picture: UInt8) -> tuple[Figure, Axes]:
    """An image that fills the width of its figure, with room for a scale or legend below."""
    height, width = picture.shape[:2]
    width_in = WIDE_IN if is_wide(picture.shape) else HALF_IN
    height_in = width_in * height / width + _BELOW_IN
    # Placed by hand, as layout engines ignore the ticks on the upper side of a scale.
    figure = new_figure(width_in, height_in, layout=None)
    axes = figure.add_axes((0.0, _BELOW_IN / height_in, 1.0, 1.0 - _BELOW_IN / height_in))
    axes.imshow(picture, aspect="auto")
    axes.set_axis_off()
    return figure, axes


def _colour_bar(
    figure: Figure, scale: str, limits: tuple[float, float], extend: str = "neither"
) -> Colorbar:
    height_in = figure.get_size_inches()[1]
    place = (0.05, _BAR_BOTTOM_IN / height_in, 0.9, _BAR_IN / height_in)
    bar = figure.colorbar(
        ScalarMappable(Normalize(*limits), cmap=scale),
        cax=figure.add_axes(place),
        orientation="horizontal",
        extend=extend,
    )
    bar.outline.set_visible(False)
    return bar


def _depth_ticks(bar: Colorbar, limits: tuple[float, float], camera: RectifiedCamera) -> None:
    """Mark round depths on the upper side of a horizontal disparity bar."""
    near_far = depth_from_disparity(np.asarray([limits[1], limits[0]]), camera)
    near = float(near_far[0])
    if not np.isfinite(near):
        return
    # A disparity near 0 is an unbounded depth; ticks up to 1 km are enough.
    far = min(float(near_far[1]), 1000.0) if np.isfinite(near_far[1]) else 1000.0

    def place(depth_m: float) -> float:
        return float(disparity_from_depth(np.asarray(depth_m), camera))

    depths = depth_marks(near, far, place, limits)
    upper = bar.ax.twiny()
    upper.set_xlim(*limits)
    upper.spines[:].set_visible(False)
    upper.set_xticks(
        [place(depth) for depth in depths], labels=[f"{depth:g} m" for depth in depths]
    )
    upper.tick_params(length=2, pad=1)
