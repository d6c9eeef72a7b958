"""The settings of ``recon settings`` as a table for each group."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from recon.commands.settings_list import SettingEntry, SettingGroup, shown_default


def print_settings(groups: Sequence[SettingGroup], console: Console | None = None) -> None:
    """Print each setting in two lines: name, default and values; what it does."""
    out = console or Console(highlight=False)
    for group in groups:
        out.print(Text.assemble((group.name, "bold"), f"  {group.purpose}"))
        for entry in group.settings:
            out.print(_headline(entry))
            out.print(Padding(Text(entry.description, style="dim"), (0, 0, 0, 6)))
        out.print()


def _headline(entry: SettingEntry) -> Text:
    return Text.assemble(
        "  ", (entry.name, "cyan"), f" = {shown_default(entry)}", (f"   [{entry.values}]", "dim")
    )
