"""The result of an audit as text: one line per check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from recon.core.words import counted

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
