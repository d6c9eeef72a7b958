"""`recon settings`: each setting with its default, unit, values and purpose."""

from __future__ import annotations

from recon.commands.config import PAIR_DEFAULTS, ReconConfig
from recon.commands.settings_list import SettingGroup, setting_groups
from recon.core.errors import SettingsError
from recon.core.settings import suggest_names


def list_settings(name: str | None = None) -> tuple[SettingGroup, ...]:
    """List the settings with a dotted name, or all below it.

    Args:
        name: Dotted name of a setting or a group, or any part of one; None = all.

    Raises:
        SettingsError: No setting has such a name.
    """
    every = tuple(setting_groups(ReconConfig(), ReconConfig.parse(PAIR_DEFAULTS)))
    if name is None:
        return every
    for match in (_lies_in, _contains):
        found = tuple(
            SettingGroup(group.name, group.purpose, chosen)
            for group in every
            if (chosen := tuple(entry for entry in group.settings if match(name, entry.name)))
        )
        if found:
            return found
    names = [entry.name for group in every for entry in group.settings]
    raise SettingsError(f"no setting is named {name!r}", hint=suggest_names(name, names))


def _lies_in(group: str, name: str) -> bool:
    return name == group or name.startswith(f"{group}.")


def _contains(part: str, name: str) -> bool:
    return part in name
