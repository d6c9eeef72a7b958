"""The report of an audit: its checks as text, sample pairs, and plots by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recon.core.text import counted
from recon.core.values import RectifiedPair
from recon.core.values.arrays import Float64
from recon.report.page import write_page
from recon.report.pair_page import disparity_figure, is_wide, pair_figure
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


_UNKNOWN = "not known"


def audit_lines(summary: Mapping[str, Any]) -> dict[str, str]:
    """Describe the measurements of an audit.

    Returns:
        Subject and text of each line, in display order.
    """
    lines = {
        "frames": _frames(summary),
        "rows": _rows(summary),
        "left, right": _eyes(summary),
        "time": _time(summary),
        "brightness": _known("right / left {:.2f}", summary["gain"]),
        "sharpness": _known(
            "left {:.2f}, right {:.2f} (0 to 1)",
            summary["sharpness_left"],
            summary["sharpness_right"],
        ),
        "disparities": _known(
            "{0:.1f} to {2:.1f} px (5 to 95 %), median {1:.1f} px",
            *summary.get("disparity_5_50_95_px", [None]),
        ),
        "rig": _rig(summary),
        "depth error": ", ".join(
            f"{_length(error)} at {at} m" for at, error in summary.get("depth_error_m", {}).items()
        )
        or _UNKNOWN,
    }
    by_motion = summary.get("rig_by_motion")
    if by_motion is not None:
        lines["by its motion"] = _by_motion(by_motion)
    mended = summary.get("mended")
    if mended is not None:
        turn = ", ".join(f"{mended[f'{x}_deg']:+.3f} deg {x}" for x in ("pitch", "yaw", "roll"))
        lines["mended"] = (
            f"{mended['calibration']}: right camera rotated by {turn}, its focal length changed by "
            f"{mended['focal_percent']:+.2f} %" + _straightened(mended["lenses_px"])
        )
    return lines


def _by_motion(found: Mapping[str, Any]) -> str:
    off = {name: _interval(found[name]) for name in ("disparity_px", "focal_percent", "lens_px")}
    depths = ", ".join(
        f"{percent:+.1f} % at {z} m" for z, percent in found["depth_percent"].items()
    )
    return (
        f"disparities lack {off['disparity_px']} px (depth {depths}), at the sides another "
        f"{off['lens_px']} px by the lenses; right focal length {off['focal_percent']} %; the "
        "baseline cannot be seen"
    )


def _straightened(moved_px: Sequence[float] | None) -> str:
    if moved_px is None:
        return ""
    left, right = moved_px
    return f", and both lenses straightened, by {left:.2f} and {right:.2f} px (rms)"


def _interval(figure: Mapping[str, float]) -> str:
    """Return a value with the half width of its 95 % interval."""
    return f"{figure['value']:+.2f} ± {1.96 * figure['sigma']:.2f}"


def _frames(summary: Mapping[str, Any]) -> str:
    frozen = max(summary["frozen_left_frames"], summary["frozen_right_frames"])
    step_s = summary["usual_step_s"]
    rate = "" if step_s is None else f" at {1 / step_s:.3g} Hz, {counted(summary['gaps'], 'gap')}"
    return (
        f"{summary['frames']}{rate}; {summary['frames_read']} examined, "
        f"{summary['repeated_frames']} repeated"
        + (f", one camera frozen for {frozen}" if frozen else "")
    )


def _rows(summary: Mapping[str, Any]) -> str:
    if "row_error_rms_px" not in summary:
        return _UNKNOWN
    return (
        f"{summary['row_error_rms_px']:.2f} px rms (mean {summary['row_error_mean_px']:+.2f}, "
        f"spread {summary['row_error_spread_px']:.2f}, feature noise "
        f"{summary['row_noise_px']:.2f}); corrected by pitch {summary['mend_pitch_deg']:+.3f}, "
        f"roll {summary['mend_roll_deg']:+.3f} deg"
    )


def _eyes(summary: Mapping[str, Any]) -> str:
    return _known("{:.0f} % of near features suggest swapped cameras", _percent(summary))


def _percent(summary: Mapping[str, Any]) -> float | None:
    share = summary["swapped_share"]
    return None if share is None else 100 * float(share)


def _time(summary: Mapping[str, Any]) -> str:
    if summary["lag_frames"]:
        return f"right camera {counted(summary['lag_frames'], 'frame', form='+d')} late"
    skew = summary["time_skew_frames"]
    # Avoids a negative zero.
    return _known("right camera {:+.2f} frames late", skew and round(skew, 2) + 0.0)


def _rig(summary: Mapping[str, Any]) -> str:
    speed = summary["speed_m_per_s"]
    moving = "" if speed is None else f", moving at {speed:.1f} m/s"
    view = f"f {summary['focal_px']:.0f} px ({summary['field_of_view_deg']:.0f} deg wide)"
    return f"baseline {_length(summary['baseline_m'])}, {view}{moving}"


def _known(text: str, *values: float | None) -> str:
    return _UNKNOWN if None in values else text.format(*values)


def _length(metres: float) -> str:
    """Return a length in a readable unit."""
    for unit, factor, under in (("mm", 1000.0, 0.01), ("cm", 100.0, 1.0)):
        if metres < under:
            return f"{metres * factor:.2g} {unit}"
    return f"{metres:.3g} m"
