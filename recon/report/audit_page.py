"""The report of an audit: its checks as text, sample pairs, and plots by frame."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from string import Formatter
from typing import Any, Final

import numpy as np

from recon.core.text import counted, length
from recon.core.values import RectifiedPair
from recon.look.sample import PairMeasures
from recon.report import style
from recon.report.page import write_page
from recon.report.pair_page import disparity_figure, is_wide, pair_figure
from recon.report.rig_part import rig_section
from recon.report.sections import Image, Page, Section, Table, known
from recon.rig.audit import Audit, middle_depth
from recon.run.directory import RunDirectory
from recon.sources.source import StereoSource
from recon.stereo.match.protocol import Matcher

_LONGER: Final = 20.0  # epipolar errors are drawn longer than they are, as the caption says
_SHOWN_ROWS_PX: Final = 5.0  # farther apart are wrong matches


def write_audit_page(
    audit: Audit, source: StereoSource, matcher: Matcher, run: RunDirectory
) -> None:
    """Write ``report.html`` of an audit; ``matcher`` finds the disparities of its sample pairs."""
    found, frames = audit.summary.to_json(), frames_figure(audit.pairs) if audit.pairs else None
    lines, caption = audit_lines(found), "Of the measured pairs, evenly spread over the recording."
    looked_at = [(look, look.shown) for look in audit.pairs if look.shown is not None]
    sections = [
        Section("Measured", [Table("All checks", (), [*lines.items()])]),
        rig_section(audit.rig),
        Section("By frame", [Image("Exposure, focus and epipolar error", frames, caption)]),
        *(_pair_section(look, pair, matcher) for look, pair in looked_at),
    ]
    depths_m, rig = found.get("depth_error_m"), found.get("rig_by_motion")
    at, off_m = middle_depth(depths_m) or ("", 0.0)
    off_at, off = next(iter(rig["depth_percent"].items())) if rig else ("10", {"mean": None})
    figures = [
        ("Epipolar error (RMS)", known("{:.2f} px", found["epipolar_error_rms_px"])),
        ("Baseline", known("{:.4g} m", found["baseline_m"])),
        (f"Depth error at {at} m, by noise", "" if depths_m is None else length(off_m)),
        (f"Depth at {off_at} m, by the rig", known("{:+.1f} %", off["mean"])),
    ]
    subtitle, texts = f"{source.description}, {lines['frames']}", [x.text for x in audit.findings]
    write_page(Page(f"Audit of {source.name}", subtitle, figures, sections, found, texts), run)


def _pair_section(look: PairMeasures, pair: RectifiedPair, matcher: Matcher) -> Section:
    disparity = matcher.match(pair)
    percent = 100 * disparity.measured.mean()
    return Section(f"Pair {look.index}", [
        Image("Images", pair_figure(pair), "Rectified, as the matcher gets them."),
        Image("Epipolar errors", epipolar_figure(look, pair) if len(look.features) else None,
              "Each matched feature with its epipolar error, right minus left, drawn "
              f"{_LONGER:g} times as long. Lines of one direction are a calibration that is off; "
              "of any, noise."),
        Image("Disparity", disparity_figure(disparity, pair.camera),
              f"Red is near, blue is far; {percent:.0f} % of the pixels have a value."),
    ])  # fmt: skip


@style.styled
def epipolar_figure(look: PairMeasures, pair: RectifiedPair) -> bytes:
    """Draw the left image with the epipolar error of each feature."""
    height, width = pair.left.shape
    size_in = style.WIDE_IN if is_wide(pair.left.shape) else style.WIDE_IN / 2
    figure = style.bare_figure(size_in, size_in * height / width)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    style.show_image(axes, pair.left)
    at, apart = look.features.left_uv, look.epipolar_error_px
    near = np.abs(apart) <= _SHOWN_ROWS_PX
    axes.quiver(
        *at[near].T, np.zeros(near.sum()), _LONGER * apart[near], apart[near],
        angles="xy", scale_units="xy", scale=1, cmap="coolwarm", clim=(-2.0, 2.0), width=0.0025,
        headwidth=2, headlength=2, headaxislength=2,
    )  # fmt: skip
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    return style.to_png(figure, f"Epipolar errors: {style.spread(apart, ' px')}")


@style.styled
def frames_figure(looks: Sequence[PairMeasures]) -> bytes:
    """Draw brightness, sharpness and epipolar error of the measured pairs."""
    labels = ("mean grey level", "sharpness (0 to 1)", "epipolar error (px)\nmedian, middle half")
    figure, (brightness, sharpness, rows) = style.stacked(6.4, "frame", labels)
    frames = [look.index for look in looks]
    grey, sharp = [look.brightness_dn for look in looks], [look.sharpness for look in looks]
    for axes, measured in ((brightness, grey), (sharpness, sharp)):
        axes.plot(frames, measured, "o-", linewidth=1.3, label=("left", "right"))
        axes.legend(ncols=2)
    brightness.set_ylim(0, 255)
    sharpness.set_ylim(bottom=0)
    known = [look for look in looks if len(look.features)]
    if known:
        spread = np.array(
            [np.quantile(look.epipolar_error_px, (0.25, 0.5, 0.75)) for look in known]
        )
        places = [look.index for look in known]
        reach = np.abs(spread[:, [0, 2]].T - spread[:, 1])
        rows.errorbar(places, spread[:, 1], reach, fmt="o", color=style.ESTIMATE, capsize=3)
    rows.axhline(0, color=style.INK, linewidth=1)
    return style.to_png(figure)


def audit_lines(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the measurements of an audit as subject and text of lines, in display order."""
    known, swapped = functools.partial(_known, summary), summary["swapped_ratio"]
    depths_m = summary.get("depth_error_m", {})
    lines = {
        "frames": _frames(summary),
        "rows": known(
            "{epipolar_error_rms_px:.2f} px rms (mean {epipolar_error_mean_px:+.2f}, "
            "spread {epipolar_error_spread_px:.2f}, feature noise {epipolar_noise_px:.2f}); "
            "corrected by pitch {repair_pitch_deg:+.3f}, roll {repair_roll_deg:+.3f} deg"
        ),
        "left, right": "not known"
        if swapped is None
        else f"{100 * swapped:.0f} % of near features suggest swapped cameras",
        "time": _time(summary),
        "brightness": known("right / left {gain:.2f}"),
        "sharpness": known("left {sharpness_left:.2f}, right {sharpness_right:.2f} (0 to 1)"),
        "disparities": known(
            "{disparity_5_50_95_px[0]:.1f} to {disparity_5_50_95_px[2]:.1f} px (5 to 95 %), "
            "median {disparity_5_50_95_px[1]:.1f} px"
        ),
        "rig": _rig(summary),
        "depth error": ", ".join(f"{length(off)} at {at} m" for at, off in depths_m.items())
        or "not known",
    }
    if (by_motion := summary.get("rig_by_motion")) is not None:
        lines["by its motion"] = _by_motion(by_motion)
    if (repaired := summary.get("repaired")) is not None:
        lines["repaired"] = _repaired(repaired)
    return lines


def _known(figures: Mapping[str, Any], text: str) -> str:
    """Put figures into a text that names them; "not known" if one is not."""
    named = {name.partition("[")[0] for _, name, _, _ in Formatter().parse(text) if name}
    known = all(figures.get(name) is not None for name in named)
    return text.format_map(figures) if known else "not known"


def _by_motion(found: Mapping[str, Any]) -> str:
    off, depths = found["disparity_px"], found["depth_percent"].items()
    far = ", ".join(f"{_depth_off(x)} at {z} m" for z, x in depths)
    moves = "" if found["fixed"] else "; moves with what is seen, as in stabilised images"
    return (
        f"disparities {off['mean']:+.2f} ± {1.96 * off['sigma']:.2f} px off, {off['rms']:.2f} px "
        f"rms over the image (depth {far}); {_turned(found)}{moves}; the baseline cannot be seen"
    )


def _depth_off(ratio: Mapping[str, float | None]) -> str:
    if ratio["mean"] is None or ratio["sigma"] is None:
        return "infinite"
    return f"{ratio['mean']:+.1f} ± {1.96 * ratio['sigma']:.1f} %"


def _repaired(repaired: Mapping[str, Any]) -> str:
    lens = repaired.get("lens_off_px")
    left = "" if lens is None else f"; lenses as near as kalibr's come, {lens:.2f} px rms off"
    return f"{', '.join(repaired['files'])}: {_turned(repaired)}{left}"


def _turned(found: Mapping[str, Any]) -> str:
    turn = ", ".join(f"{found[f'{x}_deg']:+.3f} deg {x}" for x in ("pitch", "yaw", "roll"))
    focal = f"{found['focal_percent']:+.2f} %"
    return f"right camera rotated by {turn}, its focal length changed by {focal}"


def _frames(summary: Mapping[str, Any]) -> str:
    frozen = max(summary["frozen_left_frames"], summary["frozen_right_frames"])
    step_s = summary["usual_step_s"]
    rate = "" if step_s is None else f" at {1 / step_s:.3g} Hz, {counted(summary['gaps'], 'gap')}"
    text = "{frames}" + rate + "; {frames_read} examined, {repeated_frames} repeated"
    return text.format_map(summary) + (f", one camera frozen for {frozen}" if frozen else "")


def _time(summary: Mapping[str, Any]) -> str:
    if summary["time_offset_frames"]:
        return f"right camera {counted(summary['time_offset_frames'], 'frame', form='+d')} late"
    if (skew := summary["time_skew_frames"]) is None:
        return "not known"
    return f"right camera {round(skew, 2) + 0.0:+.2f} frames late"  # not a negative zero


def _rig(summary: Mapping[str, Any]) -> str:
    speed = summary["speed_m_per_s"]
    moving = "" if speed is None else f", moving at {speed:.1f} m/s"
    view = f"f {summary['focal_px']:.0f} px ({summary['field_of_view_deg']:.0f} deg wide)"
    return f"baseline {length(summary['baseline_m'])}, {view}{moving}"
