"""The common style of all figures, drawn without pyplot: no display and no global state."""

from __future__ import annotations

import io
import math
from typing import Final, Literal

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

WIDE_IN: Final = 11.0
HALF_IN: Final = 6.2
DPI: Final = 120

ESTIMATE: Final = "#0b6bcb"
TRUTH: Final = "#e07a1f"
BAD: Final = "#cf222e"
INK: Final = "#24292f"
FAINT: Final = "#6e7781"
_LINES: Final = "#d8dee4"


def new_figure(
    width_in: float, height_in: float, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """An empty figure in the common style; ``layout`` None = the caller places the axes."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout=layout)
    figure.set_facecolor("white")
    FigureCanvasAgg(figure)
    return figure


def to_png(figure: Figure) -> bytes:
    """Render a figure to the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def style_plot(axes: Axes, x_label: str, y_label: str) -> None:
    """Style a plot: axis labels, a faint grid and no box."""
    axes.set_xlabel(x_label, color=INK)
    axes.set_ylabel(y_label, color=INK)
    axes.grid(visible=True, color=_LINES, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, length=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(_LINES)


def style_picture(axes: Axes, title: str) -> None:
    """Style an image: a title and no axis ticks."""
    axes.set_title(title, loc="left", fontsize=11, color=INK)
    axes.set_axis_off()


def write_note(axes: Axes, text: str) -> None:
    """Write a note in the centre of empty axes."""
    axes.text(0.5, 0.5, text, ha="center", va="center", color=FAINT, transform=axes.transAxes)


def nice_length(target: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most ``target`` (> 0)."""
    power = 10.0 ** math.floor(math.log10(target))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= target * (1 + 1e-9))
