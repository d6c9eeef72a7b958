"""The commands of a program, as typer has them, but for what is taken for a number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand

from recon.core.text import refuse_other_numbers


class Commands(typer.Typer):
    """A program, or a part of one, whose options take ASCII decimals alone for numbers."""

    def command(self, name: str | None = None, **how: Any) -> Callable[[Any], Any]:
        """Return the decorator that makes a function a command, see `typer.Typer.command`."""
        return super().command(name, cls=_Command, **how)


class _Command(TyperCommand):
    """A command that looks at the text of each number, see `recon.core.text`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        texts, _, _ = self.make_parser(ctx).parse_args([*args])
        left = super().parse_args(ctx, args)
        param: Any  # a class of typer's own
        for param in self.params:
            text = texts.get(param.name)
            if isinstance(text, str) and isinstance(ctx.params.get(param.name), int | float):
                try:
                    refuse_other_numbers(text)
                except ValueError as error:
                    raise typer.BadParameter(str(error), ctx, param) from error
        return left
