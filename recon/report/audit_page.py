"""The report of an audit: sample pairs with their row errors, disparity, and plots by frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recon.core.values import RectifiedPair
from recon.core.values.arrays import Float64
from recon.report.audit_table import audit_lines
from recon.report.page import write_page
from recon.report.pair_figures import disparity_figure, is_wide, pair_figure
from recon.report.style import ESTIMATE, INK, WIDE_IN, bare_figure, show_image, styled, to_png
from recon.rig.audit.audit import Audit
from recon.rig.audit.sample import Look
from recon.run.directory import RunDirectory
from recon.sources.source import StereoSource
from recon.stereo.match.protocol import Matcher

# Row errors are drawn this much longer than they are, since a pixel is invisible in a page. The
# caption says so.
_LONGER: Final = 20.0
_SHOWN_ROWS_PX: Final = 5.0  # farther apart are wrong matches


def write_audit_page(
    audit: Audit, source: StereoSource, matcher: Matcher, run: RunDirectory
) -> None:
    """Write ``report.html`` of an audit; ``matcher`` finds the disparities of its sample pairs."""
    write_page(
        "audit",
        run,
        source=source,
        lines=audit_lines(audit.summary),
        found=audit.figures,
        frames=frames_figure(audit.looks) if audit.looks else None,
        pairs=[_pair(look, look.pair, matcher) for look in audit.looks if look.pair is not None],
        warnings=[finding.text for finding in audit.findings],
        verdict=audit.verdict,
        sound=audit.verdict == "good",
    )


def _pair(look: Look, pair: RectifiedPair, matcher: Matcher) -> dict[str, Any]:
    """Return what the page shows of one pair."""
    disparity = matcher.match(pair)
    return {
        "index": look.index,
        "wide": is_wide(disparity.values.shape),
        "images": pair_figure(pair),
        "rows": rows_figure(look, pair) if len(look.features) else None,
        "disparity": disparity_figure(disparity, pair.camera),
        "valid_percent": 100 * disparity.valid.mean(),
    }


@styled
def rows_figure(look: Look, pair: RectifiedPair) -> bytes:
    """Draw the left image with the row error of each feature."""
    height, width = pair.left.shape
    size_in = WIDE_IN if is_wide(pair.left.shape) else WIDE_IN / 2
    figure = bare_figure(size_in, size_in * height / width)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    show_image(axes, pair.left)
    at, apart = look.features.left_uv, look.rows_px
    near = np.abs(apart) <= _SHOWN_ROWS_PX
    axes.quiver(
        *at[near].T, np.zeros(near.sum()), _LONGER * apart[near], apart[near],
        angles="xy", scale_units="xy", scale=1, cmap="coolwarm", clim=(-2.0, 2.0), width=0.0025,
        headwidth=2, headlength=2, headaxislength=2,
    )  # fmt: skip
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    return to_png(figure)


@styled
def frames_figure(looks: Sequence[Look]) -> bytes:
    """Draw brightness, sharpness and row error of the measured pairs."""
    figure = Figure((WIDE_IN, 6.4))
    brightness, sharpness, rows = figure.subplots(3, 1, sharex=True)
    frames = np.array([look.index for look in looks])
    _draw_sides(brightness, frames, np.array([look.brightness_dn for look in looks]))
    brightness.set(ylabel="mean grey level", ylim=(0, 255))
    _draw_sides(sharpness, frames, np.array([look.sharpness for look in looks]))
    sharpness.set(ylabel="sharpness (0 to 1)", ylim=(0, None))
    known = [look for look in looks if len(look.features)]
    if known:
        spread = np.array([np.quantile(look.rows_px, (0.25, 0.5, 0.75)) for look in known])
        places = [look.index for look in known]
        reach = np.abs(spread[:, [0, 2]].T - spread[:, 1])
        rows.errorbar(places, spread[:, 1], reach, fmt="o", color=ESTIMATE, capsize=3)
    rows.axhline(0, color=INK, linewidth=1)
    rows.set(xlabel="frame", ylabel="row error (px)\nmedian, middle half")
    return to_png(figure)


def _draw_sides(axes: Axes, frames: Float64, values: Float64) -> None:
    for side, name in enumerate(("left", "right")):
        axes.plot(frames, values[:, side], "o-", label=name, linewidth=1.3)
    axes.legend(ncols=2)
