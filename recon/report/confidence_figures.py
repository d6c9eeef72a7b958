"""Figures that show whether a confidence is calibrated. All return PNG bytes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from recon.report.canvas import FAINT, HALF_IN, new_figure, style_plot, to_png

Curves = Mapping[str, Any]
"""Curves of one matcher, as in ``summary.json``: ``reliability`` and ``sparsification``."""

_COLOURS: Final = ("#0b6bcb", "#e07a1f", "#1a7f37", "#8250df", "#cf222e")
_LEAST_SHARE: Final = 0.001


def reliability_figure(matchers: Mapping[str, Curves]) -> bytes:
    """Fraction of correct pixels by confidence (reliability diagram).

    Bins with less than a thousandth of the pixels are left out; the bars show the distribution of
    the pixels over the bins.
    """
    figure = new_figure(HALF_IN, 5.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    upper.plot((0, 1), (0, 1), color=FAINT, linestyle="--", linewidth=1, label="calibrated")
    for number, (name, curves) in enumerate(matchers.items()):
        bins, colour = curves["reliability"], _COLOURS[number % len(_COLOURS)]
        confidence, right, share = (_floats(bins[key]) for key in ("confidence", "right", "share"))
        shown = share >= _LEAST_SHARE
        label = f"{name}: ECE {curves['ece']:.3f}"
        upper.plot(confidence[shown], right[shown], "o-", color=colour, markersize=4, label=label)
        width = 1 / len(share) / len(matchers)
        places = np.arange(len(share)) / len(share) + (number + 0.5) * width
        lower.bar(places, share, width=0.9 * width, color=colour)
    upper.set_ylim(0, 1)
    lower.set_xlim(0, 1)
    upper.legend(loc="upper left", frameon=False)
    style_plot(upper, "", "share of right pixels")
    style_plot(lower, "confidence", "share of pixels")
    return to_png(figure)


def sparsification_figure(matchers: Mapping[str, Curves]) -> bytes:
    """Fraction of wrong pixels among the rest as the least confident ones are removed."""
    figure = new_figure(HALF_IN, 5.0)
    axes = figure.subplots()
    for number, (name, curves) in enumerate(matchers.items()):
        steps, colour = curves["sparsification"], _COLOURS[number % len(_COLOURS)]
        removed, wrong, best = (_floats(steps[key]) for key in ("removed", "wrong", "best"))
        label = f"{name}: AUSE {curves['ause']:.3f}"
        axes.plot(100 * removed, 100 * wrong, color=colour, linewidth=1.8, label=label)
        axes.plot(100 * removed, 100 * best, color=colour, linewidth=1.0, linestyle=":")
    axes.plot([], [], color=FAINT, linestyle=":", label="if the wrong ones went first")
    axes.set_xlim(0, 100)
    axes.set_ylim(bottom=0)
    axes.legend(loc="upper right", frameon=False)
    style_plot(axes, "pixels removed, the least certain first (%)", "wrong among the rest (%)")
    return to_png(figure)


def _floats(values: Any) -> Any:
    """float64 array, with NaN for None."""
    return np.array(values, dtype=np.float64)
