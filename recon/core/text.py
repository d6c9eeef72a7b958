"""Numbers in text: read as ASCII decimals alone, written with what they count or their unit.

Python's own ``float`` and ``int`` also take ``1_0`` for ten, and the digits of every script. Where
a file has those, something else is meant, or it is damaged.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Final

_DECIMAL_COMMA: Final = re.compile(r"[-+]?\d+,\d+", re.ASCII)
_MOST_DECIMALS: Final = 6  # of a length: micrometres are beyond every measurement here


def counted(number: int, one: str, many: str = "", *, form: str = "") -> str:
    """Return a number, written in a ``form``, of things: ``1 frame``, ``2 frames``."""
    return f"{number:{form}} {one if abs(number) == 1 else many or one + 's'}"


def metres(length_m: float, sign: str = "") -> str:
    """Return a length with its unit: three significant digits, no exponent; ``+`` shows a sign."""
    size = math.floor(math.log10(abs(length_m))) if length_m and math.isfinite(length_m) else 2
    return f"{length_m:{sign}.{min(max(2 - size, 0), _MOST_DECIMALS)}f} m"


def length(length_m: float) -> str:
    """Return a length in the unit in which it is said, such as ``2 cm``."""
    for unit, factor, under in (("µm", 1e6, 1e-3), ("mm", 1e3, 0.01), ("cm", 1e2, 1.0)):
        if length_m < under:
            return f"{length_m * factor:.2g} {unit}"
    return f"{float(f'{length_m:.3g}'):,g} m"


def round_lengths(least_m: float, most_m: float) -> tuple[float, ...]:
    """Return 1, 2 and 5 times powers of ten, from the nearest to one length to that to another."""
    first, last = (math.floor(math.log10(each_m)) for each_m in (least_m, most_m))
    series = [float(f"{n}e{k}") for k in range(first, last + 2) for n in (1, 2, 5)]
    low, high = (
        min(range(len(series)), key=lambda n: abs(math.log(series[n] / each_m)))
        for each_m in (least_m, most_m)
    )
    return tuple(series[low : high + 1])


def visible(text: str) -> str:
    """Return a text with control characters, and bytes of odd file names, escaped."""
    return "".join(
        one
        if one.isprintable() or one.isspace()
        else one.encode("unicode_escape", "backslashreplace").decode()
        for one in text
    )


def parse_number(text: str | bytes) -> float:
    """Return the number that a text is; it may be ``nan`` or ``inf``."""
    _check(text)
    return float(text)


def parse_numbers(words: Iterable[str | bytes]) -> list[float]:
    """Return the numbers that texts are, see `parse_number`."""
    return [parse_number(word) for word in words]


def parse_integer(text: str | bytes) -> int:
    """Return the whole number that a text is."""
    _check(text)
    return int(text)


def is_count(text: str) -> bool:
    """Return whether a text is ASCII digits and nothing else."""
    return text.isascii() and text.isdecimal()


def refuse_other_numbers(text: str) -> None:
    """Refuse a number for Python alone, or with a comma; text that is none is not looked at."""
    try:
        float(text)
    except ValueError:
        if not _DECIMAL_COMMA.fullmatch(text):
            return
    parse_number(text)


def _check(text: str | bytes) -> None:
    plain = text.decode("latin-1") if isinstance(text, bytes) else text
    if not plain.isascii() or "_" in plain:
        raise ValueError(f"not a decimal number: {plain!r}")
    if _DECIMAL_COMMA.fullmatch(plain):
        raise ValueError(f"decimals need a point, not a comma: {plain.replace(',', '.')}")


_UNITS: Final = {  # by what the names of figures end in
    "deg_per_100m": "°/100 m", "m_per_s": "m/s", "percent": "%", "deg": "°", "px": "px",
    "mb": "MB", "hz": "Hz", "ms": "ms", "mm": "mm", "cm": "cm", "m": "m", "s": "s",
}  # fmt: skip
_NAMED_UNITS: Final = {  # of names that do not end in it
    "bad": "%", "invalid": "%", "d1": "%", "infinite": "%",
    "seconds": "s", "seconds_per_frame": "s", "fps": "frames/s",
}  # fmt: skip
_ENDING: Final = re.compile(rf"_({'|'.join(_UNITS)})$")


def unit_of(name: str) -> str:
    """Return the unit of a figure by its name, such as ``live.latency_ms.p50``; "" = has none."""
    for part in reversed(re.split(r"[. ]", name)):
        ending = _ENDING.search(part)
        if ending or part in _NAMED_UNITS:
            return _UNITS[ending[1]] if ending else _NAMED_UNITS[part]
    return ""


def with_unit(text: str, name: str) -> str:
    """Return the text of a figure with its unit."""
    return f"{text} {unit_of(name)}".rstrip()
