"""The numbers that a user can set, and their bounds, taken from the settings themselves."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_args

from recon.core.settings import Settings


@dataclass(frozen=True)
class Number:
    name: str
    low: float | None  # None = no bound
    high: float | None
    outside: tuple[bool, bool]  # whether the lower and the upper bound themselves are refused
    whole: bool
    count: int  # how many numbers it takes; 0 = it is no list


def numbers_of(settings: type[Settings], prefix: str = "") -> Iterator[Number]:
    """Yield the numbers among settings, and among those of groups in them."""
    for name, field in settings.model_fields.items():
        if isinstance(field.default, Settings):
            yield from numbers_of(type(field.default), f"{prefix}{name}.")
            continue
        marks, kinds, count = [*field.metadata], [field.annotation], 0
        while kinds:
            kind = kinds.pop()
            marks += getattr(kind, "__metadata__", ())
            if kind in (int, float):
                yield _number(f"{prefix}{name}", _flat(marks), kind is int, count)
                break
            if getattr(kind, "__origin__", None) is tuple:
                count = len([part for part in get_args(kind) if part is not Ellipsis])
            if getattr(kind, "__origin__", None) is not dict:
                kinds += [part for part in get_args(kind) if not isinstance(part, str)][::-1]


def _flat(marks: list[Any]) -> list[Any]:
    """Return the marks, and those inside of a pydantic field."""
    return [inner for mark in marks for inner in getattr(mark, "metadata", [mark])]


def _number(name: str, marks: list[Any], whole: bool, count: int) -> Number:
    bounds = {
        kind: getattr(mark, kind)
        for mark in marks
        for kind in ("ge", "gt", "le", "lt")
        if getattr(mark, kind, None) is not None
    }
    low, high = bounds.get("ge", bounds.get("gt")), bounds.get("le", bounds.get("lt"))
    return Number(name, low, high, ("gt" in bounds, "lt" in bounds), whole, count)
