"""Settings chosen together by a name: what ``--preset`` takes, from ``presets.yaml``."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from recon.core.errors import SettingsError
from recon.io.fields import parse_yaml


def preset_values(name: str | None) -> Mapping[str, Any]:
    """Return the nested values of a preset; None = no preset, no values."""
    if name is None:
        return {}
    known = parse_yaml(presets_text(), "presets.yaml")
    if name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        raise SettingsError(
            "unknown preset",
            where="--preset",
            got=repr(name),
            expected=f"one of: {', '.join(known)}",
            hint=f"did you mean {near[0]}?" if near else "`recon settings --preset NAME` shows one",
        )
    values: Mapping[str, Any] = known[name]
    return values


def preset_text(name: str) -> str:
    """Return a preset as a file for ``--config``, with the lines that say for whom it is."""
    preset_values(name)  # refuses an unknown name
    _, _, after = presets_text().partition(f"\n{name}:\n")
    lines = after.partition("\n\n")[0].splitlines()
    return (
        "\n".join([f"# recon's preset {name}", *(line.removeprefix("  ") for line in lines)]) + "\n"
    )


@cache
def presets_text() -> str:
    """Return the file that has all presets."""
    return files("recon.commands").joinpath("presets.yaml").read_text(encoding="utf-8")
