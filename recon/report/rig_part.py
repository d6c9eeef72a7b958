"""The section of the refined rig in pages of drives: its parameters, and what they correct."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.ticker import MaxNLocator

from recon.core.text import counted
from recon.look.fault import LENS, LENS_SIGMA_PX
from recon.look.rig import RefinedRig, RigChange
from recon.report import style
from recon.report.sections import NOT_KNOWN, Image, Section, Table

_LEAST_PX: Final = 0.1  # of the scale of the field: a rig that is as calibrated has faint colours
_TURN: Final = {
    **{name: (name, "°", math.degrees(1.0)) for name in ("pitch", "yaw", "roll")},
    "zoom": ("focal length", " %", -100.0),  # of an image to be enlarged
}
_KNOWN: Final = ("value", "sigma")
_COLOURS: Final = 24  # an even number, so that 0 lies between two of them


def rig_section(rig: RefinedRig | None) -> Section:
    """Return what the motion shows of the rig; a section of nothing if it was not fitted."""
    if rig is None or rig.fitted is None:
        return Section("Rig", [])
    found, depth_m = rig.figures().to_json(), rig.changes[-1].depth_m
    field = field_figure(rig.changes[-1], (rig.camera.width_px, rig.camera.height_px))
    used = "The motion shows another rig than the calibration gives: recon map uses it."
    return Section("Rig", [
        Image("What the calibration does to disparities", field,
              f"Of what is {depth_m:g} m away: red was seen too near, blue too far."),
        Table("With the rig as given", ("figure", "off by", "sigma"), _off_rows(found), caption=(
            f"By the motion of {counted(found['windows'], 'window')} of frames. Depth: positive "
            "seems farther than it is. What no motion shows is the baseline.")),
        Table("Right camera", ("parameter", "value", "sigma", "prior"),
              _turn_rows(found["parameters"]), caption=(
            "Its rotation, and the change of its focal length. The prior is the standard "
            "deviation that is expected beforehand.")),
        Table("Lenses", ("term", "left (px)", "right (px)"),
              _lens_rows(found["parameters"]), caption=(
            "What each term of OpenCV's model moves in the corners of the image, with its "
            f"standard deviation; the prior of each is {LENS_SIGMA_PX:g} px.")),
    ], used if rig.refined else "recon map uses the rig as calibrated.")  # fmt: skip


@style.styled
def field_figure(change: RigChange, size_px: tuple[int, int]) -> bytes:
    """Draw by how much disparities of the rig given are off, over its rectified left image."""
    width, height = size_px
    off_px = np.ma.masked_invalid(change.off_px)
    limit = max(float(np.abs(off_px).max()) if off_px.count() else 0.0, _LEAST_PX)
    rows, columns = change.off_px.shape
    places = np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows)
    figure, axes = style.subplots(style.HALF_IN, 0.87 * style.HALF_IN * height / width + 1.25)
    levels = np.linspace(-limit, limit, _COLOURS + 1)
    drawn = axes.contourf(*places, off_px, levels, cmap="coolwarm")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.set(xlabel="column of the rectified left image (px)", ylabel="row (px)")
    axes.grid(visible=False)
    label = "disparity as given minus as refined (px)"
    ticks = MaxNLocator(7, symmetric=True)
    figure.colorbar(drawn, location="bottom", format="%+g", ticks=ticks, label=label, aspect=40)
    return style.to_png(figure, f"Disparities are off by {style.spread(change.off_px, ' px')}")


def _off_rows(found: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return what was wrong with what the rig given saw: figure, value, standard deviation."""
    off, time = found["disparity_px"], found["right_time_offset"]
    depths = (
        (f"depth at {depth} m", f"{of['mean']:+.1f} %", f"{of['sigma']:.1f} %")
        if of["mean"] is not None
        else (f"depth at {depth} m", "infinite", NOT_KNOWN)
        for depth, of in found["depth_percent"].items()
    )
    rows = [
        ("disparity, mean", f"{off['mean']:+.2f} px", f"{off['sigma']:.2f} px"),
        ("disparity, rms over the image", f"{off['rms']:.2f} px", NOT_KNOWN),
        *depths,
        ("epipolar error, rms over the image", f"{found['epipolar_error_px']:.2f} px", NOT_KNOWN),
    ]
    if time["sigma"] is not None:
        frames = f"{time['frames']:+.2f} frames"
        rows.append(("time offset of the right images", frames, f"{time['sigma']:.2f}"))
    return rows


def _turn_rows(parameters: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return how the right camera differs: parameter, value, standard deviation, prior."""
    rows = []
    for name, (label, unit, scale) in _TURN.items():
        of = parameters[name]
        sigmas = (f"{abs(scale) * of[key]:.2g}{unit}" for key in ("sigma", "prior"))
        rows.append((label, f"{scale * of['value']:+.4f}{unit}", *sigmas))
    return rows


def _lens_rows(parameters: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return what each term of both lenses moves at the corners, in px; [] if they were held."""
    rows = []
    for term in LENS:
        both = [parameters[f"{side}_{term}"] for side in ("left", "right")]
        if any(of["sigma"] for of in both):
            moved_px = [[LENS_SIGMA_PX * of[x] / of["prior"] for x in _KNOWN] for of in both]
            rows.append((term, *(f"{value:+.2f} ± {sigma:.2f}" for value, sigma in moved_px)))
    return rows
