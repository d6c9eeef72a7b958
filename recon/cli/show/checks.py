"""The result of ``recon doctor`` as a table."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from recon.commands.doctor import Check


def print_checks(checks: Sequence[Check], console: Console | None = None) -> None:
    """Print one line per check, and below the table the hints for those that failed."""
    out = console or Console()
    table = Table(show_edge=False, pad_edge=False)
    for title in ("", "check", "found"):
        table.add_column(title, overflow="fold")
    for check in checks:
        table.add_row(_mark(check), Text(check.name), Text(check.found))
    out.print(table)
    failed = [check for check in checks if not check.ok]
    out.print()
    for check in failed:
        out.print(Text.assemble(_mark(check), " ", check.name, ": ", check.hint))
    if not any(check.needed for check in failed):
        out.print(Text("ready", style="bold green"))


def _mark(check: Check) -> Text:
    if check.ok:
        return Text("ok", style="green")
    return Text("missing", style="bold red") if check.needed else Text("note", style="yellow")
