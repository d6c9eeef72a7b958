"""The commands of this program, as jobs of a batch see them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import typer

from recon.core.errors import SettingsError
from recon.run.batch.plan import Program

# Typer has a copy of click in it, or uses the one that is installed.
_USAGE_ERROR: Any = typer.BadParameter.__base__


def known_program() -> Program:
    """Return what jobs can run: the commands of this program that write a result."""
    from recon.cli import app
    from recon.commands.batch import COMMANDS

    root: Any = typer.main.get_command(app)

    def find(words: Iterable[str]) -> Any:
        command = root
        for word in words:
            command = getattr(command, "commands", {}).get(word) if command else None
        return command

    found = {name: find(name.split()) for name in COMMANDS}
    commands = {name: command for name, command in found.items() if command is not None}

    def check(words: Sequence[str]) -> None:
        group = 2 if words[0] not in commands else 1
        name = " ".join(words[:group])
        try:
            commands[name].make_context(f"recon {name}", list(words[group:]))
        except _USAGE_ERROR as error:
            raise SettingsError(error.format_message(), got=" ".join(words)) from error

    options = {
        name: frozenset(option for one in command.params for option in one.opts)
        for name, command in commands.items()
    }
    return Program(options, check)
