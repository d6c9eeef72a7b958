"""Options that stand for settings, as the ``key=value`` texts that `load_config` takes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.core.errors import SettingsError
from recon.core.text import is_count
from recon.stereo.match.protocol import name_of
from recon.stereo.match.registry import MatchingSettings, settings_of


def matching_overrides(matcher: str | None = None, ndisp: int | None = None) -> list[str]:
    """Return overrides for the matcher and its disparity range; None = unchanged."""
    chosen = [] if matcher is None else [f"matching.matcher={matcher}"]
    fields = MatchingSettings.model_fields
    ranged = [
        name
        for name, field in fields.items()
        if "ndisp" in getattr(field.annotation, "model_fields", ())
    ]
    return chosen + ([] if ndisp is None else [f"matching.{name}.ndisp={ndisp}" for name in ranged])


def pair_config(
    path: Path | None, overrides: Sequence[str], matcher: str | None, ndisp: int | None
) -> ReconConfig:
    """Return the configuration of one pair with its matcher and disparity range; None = kept."""
    config = load_config(path, [*overrides, *matching_overrides(matcher, ndisp)], PAIR_DEFAULTS)
    used = config.matching.matcher
    if ndisp is not None and not hasattr(settings_of(used, config.matching), "ndisp"):
        raise SettingsError(
            "the matcher has no such setting", where="--ndisp", got=f"matcher {name_of(used)!r}"
        )
    return config


def capture_overrides(size: str | None, rate_hz: float | None) -> list[str]:
    """Return overrides for a recording; None = unchanged."""
    width, cross, height = (size or "").partition("x")
    if size is not None and not (cross and is_count(width) and is_count(height)):
        raise SettingsError("cannot read this size", got=size, expected="WIDTHxHEIGHT: 1280x720")
    given = {
        "width_px": width or None,
        "height_px": height or None,
        "rate_hz": rate_hz,
    }
    return [f"capture.{key}={value}" for key, value in given.items() if value is not None]
