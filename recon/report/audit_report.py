"""The report of an audit: sample pairs with their row errors, disparity, and plots by frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from recon.cli.show.audit_table import audit_lines
from recon.commands.config import ReconConfig, dump_config
from recon.core.values import RectifiedPair
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.report.canvas import ESTIMATE, INK, TRUTH, WIDE_IN, new_figure, style_plot, to_png
from recon.report.figures import disparity_figure, is_wide, pair_figure
from recon.report.html import (
    Block,
    FigureBlock,
    ReportContent,
    Section,
    TableBlock,
    render_html,
)
from recon.report.present import command_line
from recon.rig.audit.run import Audit
from recon.rig.audit.sample import Look
from recon.run.directory import RunDirectory
from recon.run.machine import versions
from recon.run.record import fingerprint, write_record
from recon.sources import StereoSource
from recon.stereo.match import make_matcher

# Row errors are drawn this much longer than they are, since a pixel is invisible in a page.
_LONGER: Final = 20.0
_SHOWN_ROWS_PX: Final = 5.0  # farther apart are wrong matches


def present_audit(
    audit: Audit, source: StereoSource, config: ReconConfig, directory: RunDirectory
) -> None:
    """Write ``report.html``, ``summary.json`` and ``run.json`` of an audit.

    Raises:
        OutputError: A file cannot be written.
    """
    write_text(directory.path("report.html"), render_html(_content(audit, source, config)))
    directory.write_json("summary.json", audit.summary)
    record = {
        "source": source.name,
        "inputs": fingerprint(source.files),
        "warnings": [finding.text for finding in audit.findings],
    }
    write_record(directory, "audit", record)


def _content(audit: Audit, source: StereoSource, config: ReconConfig) -> ReportContent:
    looks = audit.looks
    lines = audit_lines(audit.summary)
    return ReportContent(
        title=f"Audit of {source.name}",
        subtitle=f"{source.description}, {lines['frames']}",
        command=command_line(),
        warnings=[finding.text for finding in audit.findings],
        verdict=f"Verdict: {audit.verdict}",
        sound=audit.verdict == "good",
        figures=_figures(audit),
        sections=[
            Section("Measured", [TableBlock("All checks", (), list(lines.items()), wide=True)]),
            Section("By frame", _plots(looks)),
            *(
                Section(f"Pair {look.index}", _pair_blocks(look, look.pair, config))
                for look in looks
                if look.pair is not None
            ),
        ],
        config=dump_config(config, "audit"),
        versions=versions(),
    )


def _figures(audit: Audit) -> list[tuple[str, str]]:
    found = audit.figures
    figures = [("Baseline", f"{found['baseline_m']:.4g} m")]
    if "row_error_rms_px" in found:
        figures.insert(0, ("Row error (rms)", f"{found['row_error_rms_px']:.2f} px"))
    if "depth_error_m" in found:
        figures.append(("Depth error at 10 m", f"{100 * found['depth_error_m']['10']:.2g} cm"))
    return figures


def _pair_blocks(look: Look, pair: RectifiedPair, config: ReconConfig) -> list[Block]:
    matcher = make_matcher(config.matching.matcher, config.matching, None)
    disparity = matcher.match(pair)
    wide = is_wide(disparity.values.shape)
    blocks: list[Block] = [
        FigureBlock("Images", pair_figure(pair), "Rectified, as the matcher gets them.")
    ]
    if len(look.features):
        caption = (
            f"Each matched feature with its row error, right minus left, drawn {_LONGER:.0f} times "
            "as long. Lines of one direction are a calibration that is off; of any, noise."
        )
        blocks.append(FigureBlock("Row errors", rows_figure(look, pair), caption, wide))
    share = f"{100 * disparity.valid.mean():.0f} % of the pixels have a value."
    figure = disparity_figure(disparity, pair.camera)
    return [*blocks, FigureBlock("Disparity", figure, f"Red is near, blue is far; {share}", wide)]


def rows_figure(look: Look, pair: RectifiedPair) -> bytes:
    """PNG of the left image with the row error of each feature."""
    height, width = pair.left.shape
    size_in = WIDE_IN if is_wide(pair.left.shape) else WIDE_IN / 2
    figure = new_figure(size_in, size_in * height / width, layout=None)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(pair.left, cmap="gray", vmin=0, vmax=255)
    at, apart = look.features.left_uv, look.rows_px
    near = np.abs(apart) <= _SHOWN_ROWS_PX
    axes.quiver(
        *at[near].T, np.zeros(near.sum()), _LONGER * apart[near], apart[near],
        angles="xy", scale_units="xy", scale=1, cmap="coolwarm", clim=(-2.0, 2.0), width=0.0025,
        headwidth=2, headlength=2, headaxislength=2,
    )  # fmt: skip
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_axis_off()
    return to_png(figure)


def _plots(looks: Sequence[Look]) -> list[Block]:
    if not looks:
        return []
    caption = "Of the pairs that were measured, evenly spread over the recording."
    return [FigureBlock("Exposure, focus and rows", frames_figure(looks), caption)]


def frames_figure(looks: Sequence[Look]) -> bytes:
    """PNG of brightness, sharpness and row error of the measured pairs."""
    figure = new_figure(WIDE_IN, 6.4)
    brightness, sharpness, rows = figure.subplots(3, 1, sharex=True)
    frames = np.array([look.index for look in looks])
    _draw_sides(brightness, frames, np.array([look.brightness_dn for look in looks]))
    brightness.set_ylim(0, 255)
    style_plot(brightness, "", "mean grey level")
    _draw_sides(sharpness, frames, np.array([look.sharpness for look in looks]))
    sharpness.set_ylim(bottom=0)
    style_plot(sharpness, "", "sharpness (0 to 1)")
    known = [look for look in looks if len(look.features)]
    spread = np.array([np.quantile(look.rows_px, (0.25, 0.5, 0.75)) for look in known])
    if known:
        places = [look.index for look in known]
        reach = np.abs(spread[:, [0, 2]].T - spread[:, 1])
        rows.errorbar(places, spread[:, 1], reach, fmt="o", color=ESTIMATE, capsize=3)
    rows.axhline(0, color=INK, linewidth=1)
    style_plot(rows, "frame", "row error (px)\nmedian, middle half")
    return to_png(figure)


def _draw_sides(axes: Axes, frames: Float64, values: Float64) -> None:
    for side, (name, colour) in enumerate((("left", ESTIMATE), ("right", TRUTH))):
        axes.plot(frames, values[:, side], "o-", color=colour, label=name, linewidth=1.3)
    axes.legend(frameon=False, ncols=2)
