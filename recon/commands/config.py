"""The configuration: settings of all stages, from YAML files and the command line."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from os import PathLike
from pathlib import Path
from textwrap import dedent
from typing import Any, Final, Literal, get_args, get_origin

from pydantic import model_validator
from pydantic.fields import FieldInfo
from typing_extensions import Self

from recon.core.errors import FormatError, SettingsError
from recon.core.settings import (
    Settings,
    alternatives,
    can_be_none,
    follows_scene,
    merge,
    suggest_names,
)
from recon.export.mesh.poisson import OVERLAP_M, MeshSettings
from recon.io.fields import parse_yaml
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text
from recon.look.settings import AuditedSettings
from recon.map.settings import DriveSettings
from recon.rig.capture import CaptureSettings
from recon.rig.settings import CalibratedSettings
from recon.run.finished import is_pair_run
from recon.run.run import CONFIG
from recon.sources.settings import SourceSettings
from recon.stereo.frame import ANY_SCALE
from recon.stereo.match.registry import plugin_groups, settings_taken
from recon.street.settings import StreetSettings

Changes = Sequence[str | Mapping[str, Any]]
"""Changed settings: ``key=value`` texts with dotted keys, or values by such keys."""
_MOST_DOTS: Final = 10
_NEXT: Final = re.compile(r",\s*(?=[a-z]\w*(?:\.\w+)+\s*=)")  # no comma of a list, or of a name
_BYTES_PER_PIXEL: Final = 18
"""Two colour images, and the disparity with its confidence and deviation: the least of a pair."""


class ReconConfig(DriveSettings, AuditedSettings, CalibratedSettings):
    """Everything that determines a result; written beside each result as ``config.yaml``."""

    preset: str | None = None
    """What the others began with: a name in ``presets.yaml``."""
    source: SourceSettings = SourceSettings()
    capture: CaptureSettings = CaptureSettings()
    mesh: MeshSettings = MeshSettings()
    street: StreetSettings = StreetSettings()

    @model_validator(mode="after")
    def _check_mesh(self) -> Self:
        least_m = 2 * OVERLAP_M * self.scale
        if self.scene.scale is not None and self.mesh.tile_m < least_m:
            raise ValueError(f"mesh.tile_m must be greater than or equal to {least_m:g} m")
        return self

    @property
    def readable_megapixels(self) -> float:
        """Largest image to read, in 10⁶ pixels: as set, and small enough for the memory limit."""
        limit_mb, most = self.memory.limit_mb, self.source.max_megapixels
        return most if limit_mb is None else min(most, limit_mb / _BYTES_PER_PIXEL)

    def recorded(self, command: str) -> dict[str, Any]:
        """Return the groups that determine the result of a command.

        What is open by default and open here is left out; so are the settings of matchers that
        are not used, and a street that is the usual one.
        """
        usual = (ReconConfig(), ReconConfig.parse(PAIR_DEFAULTS))
        every = _recorded(self, usual)
        groups = {name: every[name] for name in GROUPS.get(command, every) if name in every}
        if "matching" in groups:
            kept = {"matcher", "keyframe_matcher"} | settings_taken(self.matching.matcher)
            if self.matching.keyframe_matcher is not None:
                kept |= settings_taken(self.matching.keyframe_matcher)
            groups["matching"] = {k: v for k, v in groups["matching"].items() if k in kept}
        if self.street == usual[0].street:
            groups.pop("street", None)
        return groups if self.preset is None else {"preset": self.preset, **groups}


_FRAME: Final = ("source", "rectification", "matching", "cloud", "filters")
_DRIVE: Final = (
    *_FRAME, "scene", "map_filters", "rig", "odometry", "loops", "axes", "fusion", "occupancy",
    "submaps", "memory", "ground", "grid", "robot", "mesh", "street",
)  # fmt: skip
GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "map": _DRIVE,
    "demo": _DRIVE,
    "occupancy": _DRIVE,
    "export": _DRIVE,
    "mesh": ("mesh",),
    "pair": (*_FRAME, "mesh"),
    "disparity": ("source", "rectification", "matching"),
    "rectify": ("rectification",),
    "calibrate": ("source", "rectification", "calibration"),
    "audit": ("source", "rectification", "matching", "audit"),
    "evaluate-middlebury": ("rectification", "matching"),
    "paper": (*_FRAME, "mesh"),
}
"""The groups of settings that determine the result of each command."""

REMADE: Final = ("occupancy", "grid", "ground", "robot", "submaps")
"""Groups that may differ from those of a run where its rays are cast again."""

PAIR_DEFAULTS: Final[Mapping[str, Any]] = {
    "matching": {"matcher": "fine", "fill": "ours"},
    "cloud": {"min_range_m": 0.0, "max_range_m": None, "max_relative_sigma": None},
    "filters": ANY_SCALE.model_dump(),
}
"""Defaults of a single pair that differ from a drive: the scale of its scene is unknown."""


def load_config(
    path: StrPath | Mapping[str, Any] | ReconConfig | None = None,
    overrides: Changes | Mapping[str, Any] = (),
    defaults: Mapping[str, Any] | None = None,
    *,
    preset: str | None = None,
) -> ReconConfig:
    """Build the configuration; what comes later wins: defaults, preset, file, overrides.

    Keys of all mappings may be dotted or nested.

    Args:
        path: A YAML file with any part of the configuration, such as a run's ``config.yaml``; or
            its content as a mapping; or a configuration that is to be changed.
        overrides: ``key=value`` texts with dotted keys, such as ``matching.window_px=9``,
            also several with commas; or mappings; or one of them.
        defaults: Defaults of a command that differ from those of the stages.
        preset: Name of settings that are chosen together: fast, robot, survey, room or small; None
            = that which the file names, if any.

    Raises:
        SettingsError: The file cannot be read, a key is unknown, or a value is out of range.
    """
    own = _nested(_values_of(path))
    named = own.get("preset") if preset is None else preset
    chosen = {} if named is None else {"preset": named}
    usual = merge(_nested(defaults or {}), preset_values(named))
    given = merge(merge(usual, own), chosen)
    changes: dict[str, Any] = {}
    for one in [overrides] if isinstance(overrides, str | Mapping) else overrides:
        # Several settings stand in one text with commas between.
        for part in map(_parse_override, _NEXT.split(one)) if isinstance(one, str) else [one]:
            nested = _nested(part)
            if nested.get("preset") is not None:
                hint = "--preset NAME, or recon.load_config(preset=NAME)"
                raise SettingsError("a preset is not one of the settings", got=part, hint=hint)
            changes = merge(changes, nested)
    try:
        return ReconConfig.parse(merge(given, changes))
    except SettingsError:
        if isinstance(path, str | PathLike):
            ReconConfig.parse(given, where=str(path))  # blames the file if it is invalid by itself
        raise


def preset_values(name: str | None) -> Mapping[str, Any]:
    """Return the nested values of a preset; None = no preset, no values."""
    if name is None:
        return {}
    known: Mapping[str, Mapping[str, Any]] = parse_yaml(presets_text(), "presets.yaml")
    if not isinstance(name, str) or name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        raise SettingsError(
            "unknown preset",
            where="--preset",
            got=repr(name),
            expected=f"one of: {', '.join(known)}",
            hint=f"did you mean {near[0]}?" if near else "`recon settings --preset NAME` shows one",
        )
    return known[name]


def preset_text(name: str) -> str:
    """Return a preset as a file for ``--config``, with the lines that say for whom it is."""
    preset_values(name)  # refuses an unknown name
    block = presets_text().partition(f"\n{name}:\n")[2].partition("\n\n")[0]
    return f"# recon's preset {name}\n{dedent(block.rstrip())}\n"


@cache
def presets_text() -> str:
    """Return the file that has all presets."""
    return files("recon.commands").joinpath("presets.yaml").read_text(encoding="utf-8")


def _values_of(path: object) -> Mapping[str, Any]:
    if path is None or isinstance(path, Mapping):
        return path or {}
    if isinstance(path, ReconConfig):
        return path.model_dump(exclude_unset=True)
    if isinstance(path, str | PathLike):
        return _read_yaml(Path(path))
    got, expected = type(path).__name__, "a file, a mapping or a ReconConfig"
    raise SettingsError("not settings", got=got, expected=expected)


def run_settings(
    folder: Path,
    file: Path | None = None,
    overrides: Changes = (),
    without: Collection[str] = (),
    *,
    preset: str | None = None,
) -> ReconConfig:
    """Return the settings of a finished run of map, demo or pair, with changes.

    The preset comes before the file, and that before the overrides; it changes only what a
    finished run can be given. The sections ``without`` are the defaults again, since they are of
    its source.
    """
    if is_pair_run(folder):
        return load_config(file, overrides, PAIR_DEFAULTS, preset=preset)
    try:
        own = ReconConfig.parse(_nested(_read_yaml(folder / CONFIG)), where=str(folder / CONFIG))
    except SettingsError as error:
        what = f"the settings of this run are not valid in this version: {error.what}"
        how = {"where": error.where, "got": error.got, "hint": "map the drive again"}
        raise SettingsError(what, **how) from error
    known = own.model_dump(mode="json", exclude=set(without))
    given = {*REMADE, "mesh", "memory"}
    chosen = {group: part for group, part in preset_values(preset).items() if group in given}
    known = merge(known, chosen if preset is None else {**chosen, "preset": preset})
    return load_config(file, overrides, known)


def check_changes(ran: ReconConfig, config: ReconConfig, sections: Collection[str]) -> None:
    """Refuse settings that differ from those that a run had, but for those of some sections.

    What a preset says of the others is no wish: the preset is for more than these sections.
    """
    own = ran.model_dump(mode="json", exclude={"preset"})
    usual = ran if config.preset is None else load_config(None, (), own, preset=config.preset)
    for name in {*type(config).model_fields} - {*sections, "preset"}:
        value = getattr(config, name)
        if value not in (getattr(ran, name), getattr(usual, name)):
            what = "this setting has no effect here: the drive is not mapped again"
            expected = f"settings of {', '.join(sections)}"
            raise SettingsError(what, got=name, expected=expected, hint="recon map takes it")


def _recorded(settings: Settings, usual: Sequence[Settings | None]) -> dict[str, Any]:
    """Return plain values, without what is open here and in the usual settings."""
    plain = settings.model_dump(mode="json")
    for name in type(settings).model_fields:
        value, others = getattr(settings, name), [getattr(one, name, None) for one in usual]
        if isinstance(value, Settings):
            plain[name] = _recorded(value, others)
        if plain[name] == {} or (value is None and all(other is None for other in others)):
            del plain[name]
    return plain


def _read_yaml(path: Path) -> Mapping[str, Any]:
    if path.is_file() and path.stat().st_size == 0:
        return {}
    try:
        content = parse_yaml(read_text(path, SMALL_FILE_BYTES), path)
    except FormatError as error:
        raise SettingsError(error.what, where=error.where, got=error.got) from error
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        got = type(content).__name__
        raise SettingsError("configuration is not a mapping", where=path, got=got)
    return content


def _parse_override(text: str) -> dict[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        what, expected = "cannot read this setting", "key=value"
        raise SettingsError(what, where="--set", got=repr(text), expected=expected)
    try:
        return {key.strip(): parse_yaml(value, "--set")}
    except FormatError as error:
        raise SettingsError(f"value of {key!r} is not YAML", where="--set", got=value) from error


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by dotted or nested keys as nested mappings."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        inner = _nested(value) if isinstance(value, Mapping) else value
        if str(key).count(".") > _MOST_DOTS:
            raise SettingsError("cannot read this setting", got=repr(key), expected="fewer dots")
        for part in reversed(str(key).split(".")):
            inner = {part: inner}
        nested = merge(nested, inner)
    return nested


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
    "were in effect. `none` is a value where it says so. `× scale`: that on a road, times "
    "`scene.scale`; `× scale+`: up to twice that in small scenes. (pair: …) is the default "
    "of `recon pair` and `recon disparity` where it differs."
)
_BOUNDS: Final = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
_PLAIN: Final = {bool: "true, false", str: "text", int: "whole number", float: "number"}


@dataclass(frozen=True)
class SettingEntry:
    """One setting, by its dotted name; ``default_pair`` is that of `recon pair`.

    Defaults are as in YAML, of what follows the scene those on a road. The unit is empty where
    there is none.
    """

    name: str
    default: str
    default_pair: str
    unit: str
    values: str
    description: str
    follows_scene: str = ""

    @property
    def shown_default(self) -> str:
        """The default with its unit, and that of a pair where it differs."""
        unit = f" {self.unit}" if self.unit and self.default != "none" else ""
        unit += " × scale" * bool(self.follows_scene) + "+" * (self.follows_scene == "reach")
        differs = self.default_pair != self.default
        return f"{self.default}{unit}" + (f" (pair: {self.default_pair})" if differs else "")


@dataclass(frozen=True)
class SettingGroup:
    """The settings of one stage; those of groups inside it come in groups of their own."""

    name: str
    purpose: str
    settings: tuple[SettingEntry, ...]


def list_settings(name: str | None = None) -> tuple[SettingGroup, ...]:
    """List the settings of a dotted name or part of one, and all below it; None = all."""
    brought: dict[str, Any] = {"matching": {name: {} for name in plugin_groups()}}
    drive, pair = ReconConfig.parse(brought), ReconConfig.parse(merge(brought, PAIR_DEFAULTS))
    every = tuple(_groups(drive, pair))
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
    lines = ["# Settings", "<!-- Written by `recon settings --markdown`. -->", _INTRODUCTION]
    lines += ["", "## Presets", "```yaml", presets_text().rstrip("\n"), "```"]
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
    for key, field in type(drive).model_fields.items():
        value, paired, name = getattr(drive, key), getattr(pair, key), f"{prefix}{key}"
        text = " ".join((field.description or "").split())
        if isinstance(value, Settings):
            inside.append((value, paired, f"{name}.", text))
        else:
            unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
            values = (_as_yaml(value), _as_yaml(paired), unit, _values(field))
            own.append(SettingEntry(name, *values, text, follows_scene(field)))
    if own and prefix:  # not the name of a preset
        about = purpose or (type(drive).__doc__ or "").partition("\n")[0].replace("``", "`")
        yield SettingGroup(prefix.removesuffix("."), about, tuple(own))
    for group in inside:
        yield from _groups(*group)


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
