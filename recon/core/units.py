"""Units of figures, which their names tell."""

from __future__ import annotations

import re
from typing import Final

_UNITS: Final = {
    "deg_per_100m": "°/100 m", "m_per_s": "m/s", "percent": "%", "deg": "°", "px": "px",
    "mb": "MB", "hz": "Hz", "ms": "ms", "mm": "mm", "cm": "cm", "m": "m", "s": "s",
}  # fmt: skip
"""What the names of figures end in."""
_NAMED_UNITS: Final = {
    "bad": "%", "invalid": "%", "d1": "%", "infinite": "%",
    "seconds": "s", "seconds_per_frame": "s", "fps": "frames/s",
}  # fmt: skip
"""Figures whose names do not tell it."""
_ENDING: Final = re.compile(rf"_({'|'.join(_UNITS)})$")


def unit_of(name: str) -> str:
    """Return the unit of a figure, by its name or that of the group it is in.

    Args:
        name: Such as ``peak_memory_mb``, ``disparity.bad.1.0`` or ``live.latency_ms.p50``.

    Returns:
        The unit; "" = it has none, as numbers of things, shares and texts.
    """
    for part in reversed(re.split(r"[. ]", name)):
        ending = _ENDING.search(part)
        if ending or part in _NAMED_UNITS:
            return _UNITS[ending[1]] if ending else _NAMED_UNITS[part]
    return ""


def with_unit(text: str, name: str) -> str:
    """Return the text of a figure with its unit, see `unit_of`."""
    return f"{text} {unit_of(name)}".rstrip()
