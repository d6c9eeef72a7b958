"""`recon settings`: each setting with its default, unit, values and purpose."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from recon.commands.config import PAIR_DEFAULTS, ReconConfig
from recon.core.errors import SettingsError
from recon.core.settings import Settings, alternatives, can_be_none, suggest_names

#: Units by the end of a setting's name, longer endings first.
_UNITS: Final = {
    "_m_per_frame": "m per frame", "_m_per_s": "m/s", "_deg_per_100m": "° per 100 m",
    "_px": "px", "_m": "m", "_s": "s", "_hz": "Hz", "_deg": "°",
    "_dn": "grey levels", "_grey_levels": "grey levels", "_mb": "10⁶ bytes", "_percent": "%",
    "_sigmas": "standard deviations", "_cells": "cells", "_spacings": "point spacings",
    "_frames": "frames",
}  # fmt: skip
_INTRODUCTION: Final = (
    "Every setting, as `recon settings` lists them. Change one with `--set name=value`, several in "
    "a YAML file given as `--config FILE`; the `config.yaml` in the folder of a run has those that "
    "were in effect. `none` is a value where it says so. (pair: …) is the default of `recon pair` "
    "and `recon disparity` where it differs."
)
_BOUNDS: Final = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
_PLAIN: Final = {bool: "true, false", str: "text", int: "whole number", float: "number"}


@dataclass(frozen=True)
class SettingEntry:
    """One setting, by its dotted name; ``default_pair`` is that of `recon pair`.

    Defaults are as in YAML. The unit is empty where there is none.
    """

    name: str
    default: str
    default_pair: str
    unit: str
    values: str
    description: str

    @property
    def shown_default(self) -> str:
        """The default with its unit, and that of a pair where it differs."""
        unit = f" {self.unit}" if self.unit and self.default != "none" else ""
        differs = self.default_pair != self.default
        return f"{self.default}{unit}" + (f" (pair: {self.default_pair})" if differs else "")


@dataclass(frozen=True)
class SettingGroup:
    """The settings of one stage; those of groups inside it come in groups of their own."""

    name: str
    purpose: str
    settings: tuple[SettingEntry, ...]


def list_settings(name: str | None = None) -> tuple[SettingGroup, ...]:
    """List the settings with a dotted name, or all below it.

    Args:
        name: Dotted name of a setting or a group, or any part of one; None = all.
    """
    every = tuple(_groups(ReconConfig(), ReconConfig.parse(PAIR_DEFAULTS)))
    names = [entry.name for group in every for entry in group.settings]
    if name is None:
        return every
    chosen = {one for one in names if one == name or one.startswith(f"{name}.")}
    chosen = chosen or {one for one in names if name in one}
    if not chosen:
        raise SettingsError(f"no setting is named {name!r}", hint=suggest_names(name, names))
    cut = (
        replace(group, settings=tuple(one for one in group.settings if one.name in chosen))
        for group in every
    )
    return tuple(group for group in cut if group.settings)


def settings_page(groups: Sequence[SettingGroup]) -> str:
    """Return the page docs/settings.md."""
    lines = [
        "# Settings",
        "<!-- Written by `recon settings --markdown`. -->",
        _INTRODUCTION,
    ]
    for group in groups:
        lines += ["", f"## {group.name}", group.purpose, ""]
        lines += ["| setting | default | values | what it does |", "|---|---|---|---|"]
        lines += [_row(entry) for entry in group.settings]
    return "\n".join(lines) + "\n"


def _row(entry: SettingEntry) -> str:
    cells = (entry.shown_default, entry.values, entry.description)
    return f"| `{entry.name}` | " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _groups(
    drive: Settings, pair: Settings, prefix: str = "", purpose: str | None = None
) -> Iterator[SettingGroup]:
    """Yield the groups of a model, each before those inside; ``purpose`` replaces its docstring."""
    own, inside = [], []
    for name, field in type(drive).model_fields.items():
        value, paired = getattr(drive, name), getattr(pair, name)
        if isinstance(value, Settings):
            inside.append((value, paired, f"{prefix}{name}.", field.description))
        else:
            own.append(_entry(f"{prefix}{name}", field, value, paired))
    if own:
        about = purpose or (type(drive).__doc__ or "").partition("\n")[0].replace("``", "`")
        yield SettingGroup(prefix.removesuffix("."), about, tuple(own))
    for group in inside:
        yield from _groups(*group)


def _entry(name: str, field: FieldInfo, drive: Any, pair: Any) -> SettingEntry:
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    text = " ".join((field.description or "").split())
    return SettingEntry(name, _as_yaml(drive), _as_yaml(pair), unit, _values(field), text)


def _as_yaml(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, str):
        return value or '""'
    if isinstance(value, tuple):
        return f"[{', '.join(_as_yaml(part) for part in value)}]"
    if isinstance(value, Mapping):
        return json.dumps(dict(value))
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)


def _values(field: FieldInfo) -> str:
    """Return the values of a field in words: choices, kind or bounds."""
    kinds = [kind for kind in alternatives(field.annotation) if _is_written(kind)]
    words = [_kind(kind) for kind in kinds]
    bounds = [
        f"{sign} {getattr(mark, name):g}"
        for mark in field.metadata
        for name, sign in _BOUNDS.items()
        if getattr(mark, name, None) is not None
    ]
    text = ", ".join(words if not bounds or len(kinds) > 1 else bounds)
    return f"{text}, or none" if can_be_none(field) else text


def _is_written(kind: Any) -> bool:
    """Return whether a file can hold a value of this kind: not none, and no object."""
    protocol = getattr(getattr(kind, "__origin__", None), "_is_protocol", False)
    return kind is not type(None) and not protocol


def _kind(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return ", ".join(str(choice) for choice in get_args(kind))
    if get_origin(kind) is tuple:
        return "list"
    return _PLAIN.get(kind, getattr(kind, "__name__", str(kind)))
