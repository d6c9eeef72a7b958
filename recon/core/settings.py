"""Base class of every stage's settings: frozen, validated, unknown keys rejected."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from types import UnionType
from typing import Any, Final, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo
from typing_extensions import Self

from recon.core.errors import SettingsError
from recon.core.text import refuse_other_numbers

_FOLLOWS: Final = "follows_scene"
_MOST_DOUBLINGS: Final = 2


def Length(road_m: float, *, ge: float, le: float, reach: bool = False) -> Any:
    """Return the field of a length that follows from the size of the scene unless it is set.

    Its default is that of a road; see `Settings.at_scale`. ``reach``: how far a map reaches.
    """
    return Field(road_m, ge=ge, le=le, json_schema_extra={_FOLLOWS: "reach" if reach else "size"})


def scaled(road_m: float, scale: float) -> float:
    """Return a length on a road at another scale, as short as it can be written."""
    return float(f"{scale * road_m:.9g}")


def doublings_at(scale: float) -> int:
    """Return how often voxels are doubled with the depth, so that a map reaches farther.

    Depth says something up to the error that it may have on a road: robots are no smaller in a
    room. Up to that, but no more than twice, the error and the voxels double in smaller scenes.
    """
    return min(max(round(-math.log2(scale)), 0), _MOST_DOUBLINGS)


def follows_scene(field: FieldInfo) -> str:
    """Return how a field follows the scene, ``size`` or ``reach``; "" = it is no `Length`."""
    extra = field.json_schema_extra
    return str(extra.get(_FOLLOWS, "")) if isinstance(extra, dict) else ""


class Settings(BaseModel):
    """Immutable settings of one stage, without effect of environment variables.

    Each field has a default, a unit in its name, a ``Field`` with its bounds, and a docstring.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_default=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, values: Any) -> Any:
        """Read the word none as YAML's null; give parts of a group what its default has."""
        if not isinstance(values, Mapping):
            return values
        fields = cls.model_fields
        return {k: _complete(fields[k], v) if k in fields else v for k, v in values.items()}

    @field_validator("*", mode="before")
    @classmethod
    def _check_decimals(cls, value: Any, info: ValidationInfo) -> Any:
        if _is_numeric(cls.model_fields[str(info.field_name)].annotation):
            for part in value if isinstance(value, list | tuple) else [value]:
                if isinstance(part, str):
                    refuse_other_numbers(part)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        hint = f"recon.load_config(config, {{'GROUP.{name}': VALUE}}) returns a changed copy"
        raise SettingsError("settings do not change", where=name, hint=hint)

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Show only what differs from its default."""
        for name, value in super().__repr_args__():
            field = type(self).model_fields.get(name or "")
            if field is None or value != field.get_default(call_default_factory=True):
                yield name, value

    def at_scale(self, scale: float) -> Self:
        """Return settings in which a `Length` that is not set is that of a road times ``scale``.

        A reach grows with the root of the error that it may have (`doublings_at`). All of them are
        set then, so that another scale changes nothing any more.
        """
        found: dict[str, Any] = {}
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if isinstance(value, Settings):
                found[name] = value.at_scale(scale)
            elif (kind := follows_scene(field)) and name not in self.model_fields_set:
                farther = 2 ** (doublings_at(scale) / 2) if kind == "reach" else 1.0
                found[name] = scaled(value, scale * farther)
        return self.model_copy(update=found)

    def recorded(self, command: str) -> dict[str, Any]:
        """Return what is written beside the results of a command, as plain values; here all."""
        del command
        return self.model_dump(mode="json")

    @classmethod
    def parse(cls, values: Mapping[str, Any], *, where: str | None = None) -> Self:
        """Build settings from plain values; ``where`` is the file or option that they came from."""
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise settings_error(error, where=where, names=[*setting_names(cls)]) from error


def merge(base: Mapping[str, Any], update: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested mappings merged; other values of ``update`` replace those of ``base``."""
    merged = dict(base)
    for key, value in update.items():
        below = merged.get(key)
        if isinstance(value, Mapping):
            merged[key] = merge(below if isinstance(below, Mapping) else {}, value)
        else:
            merged[key] = value
    return merged


def _complete(field: FieldInfo, value: Any) -> Any:
    if value == "none" and can_be_none(field):
        return None
    if isinstance(value, Mapping) and isinstance(field.default, Settings):
        # A group may stand with other defaults than its class: keep those that are not given.
        return merge(field.default.model_dump(exclude_unset=True), value)
    return value


def _is_numeric(annotation: Any) -> bool:
    return annotation in (int, float) or any(map(_is_numeric, get_args(annotation)))


def can_be_none(field: FieldInfo) -> bool:
    """Return whether None is a value of a field; its text is then ``none``, or YAML's ``null``."""
    return type(None) in alternatives(field.annotation)


def alternatives(annotation: Any) -> tuple[Any, ...]:
    """Return the types that a union allows; of any other type, itself."""
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)


def setting_names(settings: type[BaseModel]) -> Iterator[str]:
    """Yield the dotted names of all settings of a model, including nested models."""
    for name, field in settings.model_fields.items():
        yield name
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from (f"{name}.{below}" for below in setting_names(field.annotation))


def settings_error(
    error: ValidationError, *, where: str | None = None, names: Sequence[str] = ()
) -> SettingsError:
    """Describe pydantic's first error in one line; ``names`` are suggested for an unknown one."""
    first = error.errors()[0]
    key, inner = ".".join(str(part) for part in first["loc"]), first["input"]
    if first["type"] == "extra_forbidden":
        while isinstance(inner, Mapping) and inner:  # of an unknown group, its first setting
            key = f"{key}.{(name := next(iter(inner)))}"
            inner = inner[name]
        return SettingsError(
            f"unknown setting {key!r}", where=where, hint=suggest_names(key, names)
        )
    # Our own message, without the prefix that pydantic adds.
    said = first.get("ctx", {}).get("error", first["msg"])
    what = f"setting {key!r}: {said}" if first["loc"] else str(said)
    group = isinstance(first["input"], Mapping | BaseModel)
    return SettingsError(what, where=where, got=None if group else repr(first["input"]))


def suggest_names(unknown: str, names: Sequence[str]) -> str:
    """Suggest settings of that name elsewhere, or with a similar name."""
    last = unknown.rpartition(".")[2]
    meant = [name for name in names if name.rpartition(".")[2] == last]
    meant = meant or difflib.get_close_matches(unknown, names, n=3, cutoff=0.8)
    listed = "`recon settings` lists them all"
    return f"did you mean {' or '.join(meant[:4])}? {listed}" if meant else listed
