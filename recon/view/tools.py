"""What places that were clicked measure, and which points are within limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from recon.core.text import counted, metres
from recon.core.values.arrays import Bool, Float64, UInt8
from recon.report.scene import Points, near_others

Limits = Mapping[str, tuple[float, float]]
LIMITS: Final = {  # by which values points are chosen, for people
    "x": "Forward, x (m)", "y": "Left, y (m)", "height": "Up, z (m)",
    "age": "Time in its drive (s)", "session": "Drives",
}  # fmt: skip
_STEP_M: Final = 1e-4  # of slopes: far below what is measured, far above how floats are rounded
_LEVEL: Final = np.array([1.0, 1.0, 0.0])


def _path(m: Float64) -> float:
    return float(np.linalg.norm(np.diff(m, axis=0), axis=1).sum())


def _area(m: Float64) -> float:
    """Return the area of a polygon across the plane that fits it. Ref: Newell's formula."""
    return float(np.linalg.norm(np.cross(m - m[0], np.roll(m, -1, axis=0) - m[0]).sum(axis=0)) / 2)


#: By tool, the fewest places that it needs, and its figures of places (N, 3) and of the height of
#: the ground at the last of them.
TOOLS: Final[Mapping[str, tuple[int, Mapping[str, Callable[[Float64, float], float]]]]] = {
    "distance": (2, {
        "distance": lambda m, _: _path(m), "horizontal": lambda m, _: _path(m * _LEVEL),
        "height difference": lambda m, _: m[-1, 2] - m[0, 2],
    }),
    "height": (1, {"above the ground": lambda m, ground_m: m[-1, 2] - ground_m}),
    "area": (3, {
        "area": lambda m, _: _area(m), "seen from above": lambda m, _: _area(m * _LEVEL),
    }),
}  # fmt: skip


def measure(tool: str, places_m: Float64, sigma_m: Float64, ground_m: float) -> list[str]:
    """Return what one of `TOOLS` measures of places (N, 3), a figure a line.

    Each is followed by its standard deviation, where those of the places, ``sigma_m`` (N,), are
    known: in whatever direction counts. NaN of them, or of ``ground_m``, is unknown.
    """
    (fewest, figures), unit = TOOLS[tool], "m²" if tool == "area" else "m"
    if len(places_m) < fewest:
        return [f"{len(places_m)} of {counted(fewest, 'place')} clicked"]
    steps, lines = _STEP_M * np.eye(places_m.size).reshape(-1, *places_m.shape), []
    for name, of in figures.items():
        value = of(places_m, ground_m)
        ends = [of(places_m + step, ground_m) - of(places_m - step, ground_m) for step in steps]
        slopes = np.linalg.norm(np.reshape(ends, places_m.shape), axis=1) / (2 * _STEP_M)
        sigma = float(np.linalg.norm((slopes * sigma_m)[slopes > 0.0]))
        said = metres(value).replace("m", unit)
        if sigma > 0.0:  # two digits of it, and the figure as far as they
            decimals = max(0, 1 - math.floor(math.log10(sigma)))
            said = f"{value:.{decimals}f} ± {sigma:.{decimals}f} {unit}"
        lines.append(f"{name}: {'not known there' if np.isnan(value) else said}")
    return lines


def within(part: Points, limits: Limits) -> Bool:
    """Return which points (N,) have values within limits, or unknown ones."""
    keep = np.ones(len(part.cloud), np.bool_)
    for by, (low, high) in limits.items():
        if (values := part.values(by)) is not None:
            keep &= ~((values < low) | (values > high))
    return keep


def limited(part: Points, rgb: UInt8, limits: Limits) -> tuple[Points, UInt8]:
    """Return the points of a part that are within limits, itself if all are, and their colours."""
    keep = within(part, limits)
    return (part, rgb) if keep.all() else (Points("", part.cloud.select(keep)), rgb[keep])


def ends_of(parts: Sequence[Points], by: str) -> tuple[int, int]:
    """Return whole numbers that the values of most points are between; zeros = unknown."""
    found = [values[::16] for part in parts if (values := part.values(by)) is not None]
    known = np.concatenate([*found, np.zeros(0)]) if len(found) == len(parts) else np.zeros(0)
    known = known[near_others(known[:, None]) | (by == "session")]
    return (math.floor(known.min()), math.ceil(known.max())) if len(known) else (0, 0)
