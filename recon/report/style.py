"""The look that all figures share: no display is needed; one colour scale per kind of value."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib.style
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from recon.core.errors import ShapeError
from recon.core.text import visible
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, OccupancyTruth, Reason
from recon.core.values.arrays import Bool, UInt8
from recon.evaluation.occupancy import grid_on_truth

WIDE_IN: Final = 11.0  # width of a figure that fills the page
HALF_IN: Final = 6.2  # width of a figure with another one beside it
ESTIMATE: Final = "#0b6bcb"
TRUTH: Final = "#e07a1f"
BAD: Final = "#cf222e"
INK: Final = "#24292f"
FAINT: Final = "#6e7781"

# Decorator of a function that draws: the style sheet holds while it runs.
styled = matplotlib.style.context(Path(__file__).with_name("figures.mplstyle"))


def bare_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure, whose axes are placed by hand."""
    figure = Figure((width_in, height_in))
    figure.set_layout_engine("none")
    return figure


PICTURES: Final = "Pictures"  # in a PNG: JSON, rectangles [left, top, right, bottom] in pixels
SEEN: Final = "Description"  # in a PNG: what is to be seen in it


def to_png(figure: Figure, seen: str = "") -> bytes:
    """Render a figure as a PNG file, which says in words what is seen in it.

    To ``seen`` is added where lines go. Noted are also the rectangles whose colours are values: a
    dark page must not change these.
    """
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba()))
    said = ". ".join(filter(None, [seen, *map(_lines_seen, figure.axes)]))
    return pack_png(image, {SEEN: said, PICTURES: json.dumps(_pictures(figure))})


def pack_png(image: Image.Image, notes: Mapping[str, str]) -> bytes:
    """Return an image as a PNG file with notes."""
    buffer, info = io.BytesIO(), PngInfo()
    for name, text in notes.items():
        info.add_text(name, visible(text))  # bytes that are no text, too
    # Pages embed WebP; to pack these bytes well would take longer than to draw the figure.
    image.save(buffer, "PNG", compress_level=1, pnginfo=info)
    return buffer.getvalue()


def spread(values: ArrayLike, unit: str = "") -> str:
    """Return between what and around what values are, in words; NaN is left out."""
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    if not known.size:
        return "nothing known"
    low, middle, high = (f"{x:.4g}" for x in np.quantile(known, (0.0, 0.5, 1.0)))
    return (low if low == high else f"{low} to {high}{unit}, median {middle}") + unit


def _lines_seen(axes: Axes) -> str:
    """Say where the lines of axes go: those with a name, or else the first."""
    named = {str(line.get_label()): line for line in axes.lines}
    shown = {name: line for name, line in named.items() if not name.startswith("_")}
    lines = shown or {"": axes.lines[0]} if axes.lines else {}
    found = [f"{name} {spread(line.get_ydata(orig=False))}" for name, line in lines.items()]
    label = " ".join(axes.get_ylabel().split())
    return f"{label}: {'; '.join(map(str.strip, found))}" if label and found else ""


def _pictures(figure: Figure) -> list[list[int]]:
    """Return the rectangles where colours are values, with what explains them in a legend."""
    boxes = [axes.bbox for axes in figure.axes if any(map(_has_values, axes.get_children()))]
    if boxes:  # the ends of a colour bar, and the keys of its figure
        ends = [end for axes in figure.axes for end in axes.patches if not end.get_clip_on()]
        keys = [key for legend in figure.legends for key in legend.legend_handles if key]
        boxes += [one.get_window_extent() for one in (*ends, *keys)]
    top = figure.bbox.height
    corners = [(box.x0, top - box.y1, box.x1, top - box.y0) for box in boxes]
    return [[*map(math.floor, each[:2]), *map(math.ceil, each[2:])] for each in corners]


def _has_values(drawn: object) -> bool:
    return isinstance(drawn, ScalarMappable) and drawn.get_array() is not None


def label_of(name: str) -> str:
    """Return a name of others as matplotlib draws it: no formula, and bytes that are no text."""
    return name.encode(errors="backslashreplace").decode().replace("$", r"\$")


def show_image(axes: Axes, image: object, title: str = "") -> None:
    """Show an image without ticks; grey from 0 to 255 or RGB."""
    axes.imshow(image, vmin=0, vmax=255)  # type: ignore[arg-type]
    axes.set_title(title)
    axes.set_axis_off()


def subplots(
    width_in: float, height_in: float, rows: int = 1, columns: int = 1, **layout: Any
) -> tuple[Figure, Any]:
    """Return a figure and its axes: one, or an array of several."""
    figure = Figure((width_in, height_in))
    return figure, figure.subplots(rows, columns, **layout)


def stacked(height_in: float, xlabel: str, ylabels: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Return a wide figure of axes above each other that share x, and these axes."""
    figure, rows = subplots(WIDE_IN, height_in, len(ylabels), sharex=True)
    for axes, label in zip(rows, ylabels, strict=True):
        axes.set_ylabel(label)
    rows[-1].set_xlabel(xlabel)
    return figure, [*rows]


def shade(axes: Axes, places: Iterable[float], width: float, colour: str = BAD) -> None:
    """Mark places along x."""
    for place in places:
        axes.axvspan(place - 0.5 * width, place + 0.5 * width, color=colour, alpha=0.2, linewidth=0)


def write_note(axes: Axes, text: str) -> None:
    """Write a note in the centre of empty axes."""
    axes.text(0.5, 0.5, text, ha="center", va="center", color=FAINT, transform=axes.transAxes)


Rgb = tuple[int, int, int]

DISPARITY_SCALE: Final = "turbo"
CONFIDENCE_SCALE: Final = "viridis"
ERROR_SCALE: Final = "RdYlBu_r"
MISSING: Final[Rgb] = (20, 22, 26)

_HATCHES: Final = 90  # lines of a hatch along the longer side of an image: some 8 px in a page

# Valid pixels recede and each failure stands out, also in lightness.
REASON_COLOURS: Final[Mapping[Reason, Rgb]] = {
    Reason.VALID: (226, 232, 236),
    Reason.LOW_TEXTURE: (86, 180, 233),
    Reason.AMBIGUOUS: (230, 159, 0),
    Reason.LEFT_RIGHT: (213, 94, 0),
    Reason.OCCLUDED: (140, 30, 80),
    Reason.OUT_OF_RANGE: (0, 114, 178),
    Reason.BORDER: (70, 76, 84),
    Reason.SPECKLE: (240, 100, 180),
    Reason.EDGE: (0, 158, 115),
    Reason.FILLED: (180, 190, 160),
}
REASON_LABELS: Final[Mapping[Reason, str]] = {
    **{reason: reason.name.lower().replace("_", " ") for reason in Reason},
    Reason.LEFT_RIGHT: "left-right check",
    Reason.VALID: "measured",
    Reason.FILLED: "inferred",
}
_GRID_IMAGE_PX: Final = 1500
GRID_FREE: Final[Rgb] = (247, 249, 250)
GRID_OCCUPIED: Final[Rgb] = (24, 28, 34)
GRID_UNKNOWN: Final[Rgb] = (190, 197, 204)
# Correct cells keep the colours of a grid; cells that do not count are darker.
GRID_ERRORS: Final[Mapping[tuple[int, int], Rgb]] = {
    (FREE, FREE): GRID_FREE,
    (FREE, OCCUPIED): (230, 159, 0),
    (FREE, UNKNOWN): (160, 220, 190),
    (OCCUPIED, FREE): (213, 40, 40),
    (OCCUPIED, OCCUPIED): GRID_OCCUPIED,
    (OCCUPIED, UNKNOWN): (0, 114, 178),
}
GRID_NOT_COUNTED: Final[Rgb] = (120, 128, 136)


def colour_disparity(values: NDArray[Any], limits: tuple[float, float] | None = None) -> UInt8:
    """Colour a disparity map (H, W): far is blue, near is red; None = limits of `value_range`."""
    return colour_values(values, DISPARITY_SCALE, limits or value_range(values))


def hatch(image: UInt8, mask: Bool) -> UInt8:
    """Return an image (H, W, 3) with diagonal lines where a mask (H, W) is set."""
    row, column = np.ogrid[: mask.shape[0], : mask.shape[1]]
    period = max(6, max(mask.shape) // _HATCHES)
    place = np.where(mask, (row + column) % period / period, 1.0)[:, :, None]
    # White beside dark is seen on every colour.
    lines = np.where(place < 0.2, np.uint8(255), np.array(MISSING, np.uint8))
    return np.where(place < 0.4, lines, image)


def hatch_key() -> Patch:
    """Return the entry of a legend for what is hatched: it was inferred."""
    return Patch(fc="white", ec=INK, hatch="////", lw=0.5, label="inferred from planes around")


def colour_confidence(confidence: NDArray[Any]) -> UInt8:
    """Colour a confidence map (H, W) in [0, 1]; 0 (no match) is almost black."""
    known = np.where(confidence > 0, confidence, np.nan)
    return colour_values(known, CONFIDENCE_SCALE, (0.0, 1.0))


def colour_error(error: NDArray[Any], limit: float) -> UInt8:
    """Colour absolute errors: 0 is blue, ``limit`` and above is red."""
    return colour_values(np.abs(error), ERROR_SCALE, (0.0, limit))


def colour_reasons(reason: UInt8) -> UInt8:
    """Colour a map of `Reason` codes (H, W) by `REASON_COLOURS`."""
    table = np.array([REASON_COLOURS[code] for code in sorted(Reason)], dtype=np.uint8)
    highest = int(reason.max(initial=0))
    if highest >= len(table):
        raise ShapeError("reason code is unknown", got=highest, expected=f"0 to {len(table) - 1}")
    return table[reason]


def colour_grid(grid: OccupancyGrid) -> UInt8:
    """Colour a grid, free almost white and occupied almost black; row 0 is the largest y."""
    image = np.full((*grid.cells.shape, 3), GRID_UNKNOWN, dtype=np.uint8)
    image[grid.cells == FREE] = GRID_FREE
    image[grid.cells == OCCUPIED] = GRID_OCCUPIED
    return image[::-1]


def colour_grid_errors(grid: OccupancyGrid, truth: OccupancyTruth) -> UInt8:
    """Colour a grid by `GRID_ERRORS`, unseen cells grey; each cell is a square of pixels."""
    cells = grid_on_truth(grid, truth)
    image = np.full((*cells.shape, 3), GRID_NOT_COUNTED, dtype=np.uint8)
    for (true, found), colour in GRID_ERRORS.items():
        image[truth.seen & (truth.grid.cells == true) & (cells == found)] = colour
    side = max(1, _GRID_IMAGE_PX // max(image.shape[:2]))
    return np.asarray(image[::-1].repeat(side, axis=0).repeat(side, axis=1))


def colour_values(values: NDArray[Any], scale: str, limits: tuple[float, float]) -> UInt8:
    """Colour values of any shape by a matplotlib colormap; NaN gets `MISSING`."""
    colormap = colormaps[scale].with_extremes(bad=unit_colour(MISSING))
    shown = Normalize(*limits, clip=True)(np.ma.masked_invalid(values))
    return np.asarray(colormap(shown, bytes=True)[..., :3])


def value_range(values: NDArray[Any]) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the finite values; a range that is never empty."""
    finite = np.asarray(values)[np.isfinite(values)]
    low, high = np.percentile(finite, (1.0, 99.0)).tolist() if finite.size else (0.0, 1.0)
    return (low, high) if high > low else (low, low + 1.0)


def unit_colour(colour: Rgb) -> tuple[float, float, float]:
    """Return a colour for matplotlib, with components in [0, 1]."""
    red, green, blue = colour
    return red / 255, green / 255, blue / 255


def colour_key(label: str, colour: Rgb) -> Patch:
    """Return an entry of a legend: what a colour stands for."""
    return Patch(facecolor=unit_colour(colour), edgecolor=FAINT, linewidth=0.5, label=label)
