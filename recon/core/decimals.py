"""Numbers in text from outside: ASCII decimals alone, by every reader and option.

Python's own ``float`` and ``int`` also take ``1_0`` for ten, and the digits of every script. Where
a file has those, something else is meant, or it is damaged.
"""

from __future__ import annotations

from collections.abc import Iterable


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
    """Refuse what is a number for Python alone; text that is none at all is not looked at."""
    try:
        float(text)
    except ValueError:
        return
    parse_number(text)


def _check(text: str | bytes) -> None:
    """Refuse underscores, and digits of other scripts."""
    plain = text.decode("latin-1") if isinstance(text, bytes) else text
    if not plain.isascii() or "_" in plain:
        raise ValueError(f"not a decimal number: {plain!r}")
