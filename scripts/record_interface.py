#!/usr/bin/env python3
"""Write what the interface is: docs/commands.md and tests/architecture/interface.txt.

Both are made from the code, so that a change of an option or of a public name is seen in a review.
`make interface` runs this; the tests say when it has to be run again.
"""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
import typer.main

from recon.cli import app

ROOT = Path(__file__).parents[1]
COMMANDS = ROOT / "docs" / "commands.md"
NAMES = ROOT / "tests" / "architecture" / "interface.txt"

INTRODUCTION = """\
# Every command
Written by `make interface` from `recon COMMAND --help`. What all commands share, and what they
write: [the command line](cli.md).
"""
#: Options of all commands: their table is in docs/cli.md.
COMMON = {"--config", "--set", "--json", "--quiet", "--verbose", "--threads", "--help"}


def public_names() -> list[str]:
    """Return a line for each public name: its members, parameters and their defaults."""
    package = griffe.load("recon", search_paths=[ROOT], resolve_aliases=True)
    names = sorted(re.findall(r"import (\w+) as", (ROOT / "recon" / "__init__.pyi").read_text()))
    return [line for name in names for line in _lines(name, package[name].final_target)]


def _lines(name: str, found: Any) -> Iterator[str]:
    if found.is_function:
        yield f"{name}({_parameters(found)})"
    elif found.is_attribute:
        is_enum = any("Enum" in str(base) for base in found.parent.bases)
        yield f"{name} = {found.value}" if is_enum else name
    else:
        made = found.all_members.get("__init__")
        yield f"{name}({_parameters(made)})" if made is not None else name
        for member, value in sorted(found.all_members.items()):
            if not member.startswith("_") and value.canonical_path.startswith("recon."):
                yield from _lines(f"{name}.{member}", value)


def _parameters(function: Any) -> str:
    """Return the parameters as they are written, without self, annotations and long defaults."""
    parts, named = [], False
    for one in function.parameters:
        if one.name in ("self", "cls"):
            continue
        kind = one.kind.value
        if kind == "keyword-only" and not named:
            parts.append("*")
        named |= kind in ("keyword-only", "variadic positional")
        stars = {"variadic positional": "*", "variadic keyword": "**"}.get(kind, "")
        default = f"={one.default}" if one.default is not None and not stars else ""
        parts.append(f"{stars}{one.name}{default}")
    return ", ".join(parts)


def commands_page() -> str:
    """Return the page of commands: what each does, its examples, and a table of its options."""
    root = typer.main.get_command(app)
    context = root.make_context("recon", ["doctor"])
    return INTRODUCTION + "".join(_sections(root, context))


def _sections(group: Any, above: Any) -> Iterator[str]:
    for name, command in group.commands.items():
        if command.hidden:
            continue
        context = command.context_class(command, info_name=name, parent=above)
        if hasattr(command, "commands"):
            yield from _sections(command, context)
        else:
            yield _section(command, context)


def _section(command: Any, context: Any) -> str:
    text, _, examples = inspect.cleandoc(command.help or "").partition("\nExamples:\n")
    words = [context.command_path, *command.collect_usage_pieces(context)]
    parts = [f"## {context.command_path}", f"`{' '.join(words)}`", _prose(text)]
    if examples:
        parts.append(f"```text\n{inspect.cleandoc(examples)}\n```")
    rows = [_row(one, context) for one in command.get_params(context)]
    rows = [row for row in rows if row]
    if rows:
        parts.append("\n".join(["| option | |", "|---|---|", *rows]))
    return "\n" + "\n\n".join(parts) + "\n"


def _prose(text: str) -> str:
    """Return paragraphs of a help text on one line each, without the marks of click."""
    paragraphs = text.replace("\b\n", "").strip().split("\n\n")
    return "\n\n".join(" ".join(part.split()) for part in paragraphs)


def _row(parameter: Any, context: Any) -> str:
    if COMMON & set(parameter.opts):
        return ""
    record = parameter.get_help_record(context)
    if record is None:
        return ""
    names, text = (" ".join(part.split()).replace("|", "\\|") for part in record)
    text = text.replace("<", "&lt;").replace("[", r"\[")  # neither HTML nor a link
    return f"| `{names}` | {text} |"


def main() -> None:
    COMMANDS.write_text(commands_page())
    NAMES.write_text("\n".join(public_names()) + "\n")


if __name__ == "__main__":
    main()
