"""The look that all figures share, drawn without pyplot: no display is needed."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Final

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDE_IN: Final = 11.0
"""Width of a figure that fills the page."""
HALF_IN: Final = 6.2
"""Width of a figure with another one beside it."""

ESTIMATE: Final = "#0b6bcb"
TRUTH: Final = "#e07a1f"
BAD: Final = "#cf222e"
INK: Final = "#24292f"
FAINT: Final = "#6e7781"

styled = matplotlib.style.context(Path(__file__).with_name("figures.mplstyle"))
"""Decorator of a function that draws: the style sheet holds while it runs."""


def bare_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure whose axes are placed by hand."""
    figure = Figure((width_in, height_in))
    figure.set_layout_engine("none")
    return figure


def to_png(figure: Figure) -> bytes:
    """Render a figure to the bytes of a PNG file."""
    buffer = io.BytesIO()
    # Pages embed WebP; to pack these bytes well would take longer than to draw the figure.
    figure.savefig(buffer, format="png", pil_kwargs={"compress_level": 1})
    return buffer.getvalue()


def show_image(axes: Axes, image: object, title: str = "") -> None:
    """Show an image without ticks; grey from 0 to 255 or RGB."""
    axes.imshow(image, vmin=0, vmax=255)  # type: ignore[arg-type]
    axes.set_title(title)
    axes.set_axis_off()


def write_note(axes: Axes, text: str) -> None:
    """Write a note in the centre of empty axes."""
    axes.text(0.5, 0.5, text, ha="center", va="center", color=FAINT, transform=axes.transAxes)


def nice_length(target: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most ``target`` (> 0)."""
    power = 10.0 ** math.floor(math.log10(target))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= target * (1 + 1e-9))
