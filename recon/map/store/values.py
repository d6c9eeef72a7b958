"""Values made of what records hold: each part is checked against what its class says it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import lru_cache
from typing import Any, TypeVar, get_origin, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from recon.core.errors import ShapeError

Value = TypeVar("Value")


def value_in(kind: type[Value], tree: Mapping[str, Any]) -> Value:
    """Return a dataclass of a tree of its fields; it checks shapes and ranges of arrays itself."""
    return kind(**{name: _part(kind, name, part) for name, part in tree.items()})


def _part(kind: Any, name: str, part: Any) -> Any:
    adapter: TypeAdapter[Any] | None = _adapters(kind).get(name)
    if adapter is None:
        if not isinstance(part, np.ndarray):
            raise ShapeError(f"{kind.__name__}.{name} is not an array", got=part)
        return part
    try:
        return adapter.validate_python(part)
    except ValidationError as error:
        (first, *_), what = error.errors(), f"{kind.__name__}.{name} is wrong"
        raise ShapeError(what, got=part, expected=first["msg"]) from error


@lru_cache
def _adapters(kind: Any) -> dict[str, TypeAdapter[Any]]:
    """Return what checks each field that is no array."""
    hints = get_type_hints(kind)
    plain = (one.name for one in fields(kind) if get_origin(hints[one.name]) is not np.ndarray)
    return {name: TypeAdapter(hints[name]) for name in plain}
