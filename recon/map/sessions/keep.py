"""What of its drives a map keeps, as a user says it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from recon.core.errors import SettingsError
from recon.core.text import parse_numbers
from recon.core.values.arrays import Bool, Float64

DRIVES: Final = 2
"""Drives that must have seen a place again before an older one forgets it: one may be wrong."""


@dataclass(frozen=True)
class Keep:
    """What a map keeps; None = nothing is forgotten for this reason.

    ``drives`` are how many drives of a place are kept, and of older ones what these did not see;
    ``days`` how much older than the newest a drive may be; ``region`` the least x and y, and the
    largest, of what is kept, map axes.
    """

    drives: int | None = None
    days: float | None = None
    region: tuple[float, float, float, float] | None = None

    @classmethod
    def parse(cls, texts: Sequence[str], where: str) -> Keep:
        """Return what texts say, each one condition; `SettingsError` if one is none, or twice."""
        found: dict[str, Any] = {}
        for text in texts:
            name, value = _condition(text)
            if not name or name in found or (found and "all" in (name, *found)):
                what, least = "not what a map may keep", "X0,Y0,X1,Y1 in metres, the least first"
                expected = f"drives (2), days (90d), {least}, each once; or all"
                raise SettingsError(what, where=where, got=text, expected=expected)
            found[name] = value
        found.pop("all", None)
        return cls(**found)

    def outside(self, places_m: Float64) -> Bool:
        """Return bool (N,), which places (N, 3) in map axes are not in the region."""
        if self.region is None:
            return np.zeros(len(places_m), np.bool_)
        low, high = np.reshape(self.region, (2, 2))
        return np.asarray(((places_m[:, :2] < low) | (places_m[:, :2] > high)).any(axis=1))


def _condition(text: str) -> tuple[str, Any]:
    """Return which condition a text is, "" = none, and its value."""
    try:
        numbers = parse_numbers(text.removesuffix("d").split(","))
    except ValueError:
        return ("all" if text == "all" else ""), None
    match numbers if np.isfinite(numbers).all() else [], text.endswith("d"):
        case [days], True if days >= 0:
            return "days", days
        case [drives], False if drives >= 1 and drives == int(drives):
            return "drives", int(drives)
        case [x0, y0, x1, y1], False if x0 < x1 and y0 < y1:
            return "region", (x0, y0, x1, y1)
    return "", None
