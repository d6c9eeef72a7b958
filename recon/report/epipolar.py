"""Images of pairs with epipolar lines, before and after rectification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recon.core.values.arrays import Float64, UInt8
from recon.io.atomic import write_bytes
from recon.report.style import WIDE_IN, show_image, styled, to_png
from recon.rig.rectification import RectifyRun
from recon.run.directory import RunDirectory


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
