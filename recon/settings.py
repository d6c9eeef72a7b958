"""The base of every stage's settings: frozen, checked, unknown keys refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError
from typing_extensions import Self

from recon.errors import SettingsError


class Settings(BaseModel):
    """Immutable settings of one stage.

    Subclasses give each field a default, a unit in its name and a ``Field(description=…)``
    with its bounds. Two equal settings give equal results: no environment variable counts.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    @classmethod
    def parse(cls, values: Mapping[str, Any], *, where: str | None = None) -> Self:
        """Build settings from plain values.

        Args:
            values: Nested mapping, as read from YAML.
            where: Named in the error: the file or option that the values came from.

        Raises:
            SettingsError: A key is unknown or a value out of range; the first is named.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise settings_error(error, where=where) from error


def settings_error(error: ValidationError, *, where: str | None = None) -> SettingsError:
    """Tell pydantic's first complaint in one line."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "settings"
    if first["type"] == "extra_forbidden":
        return SettingsError(
            f"unknown setting {key!r}", where=where, hint="`config.yaml` of any run lists them all"
        )
    return SettingsError(
        f"setting {key!r}: {first['msg']}", where=where, got=repr(first.get("input"))
    )
