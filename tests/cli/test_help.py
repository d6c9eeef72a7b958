"""The help of every command says what it does, what its defaults are, and how to call it."""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from recon.cli import app

GROUP = typer.main.get_command(app)


def command_names() -> Iterator[tuple[str, ...]]:
    for name, command in GROUP.commands.items():  # type: ignore[attr-defined]
        inside = getattr(command, "commands", None)
        yield from ((name, child) for child in inside) if inside else [(name,)]


def _command(words: tuple[str, ...]) -> Any:
    command: Any = GROUP
    for word in words:
        command = command.commands[word]
    return command


@cache
def help_of(*words: str) -> str:
    done = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "200", "TERM": "dumb"})
    assert done.exit_code == 0, done.output
    return done.output


COMMANDS = sorted(command_names())
every_command = pytest.mark.parametrize("words", COMMANDS, ids=" ".join)


def examples_of(words: tuple[str, ...]) -> list[str]:
    return re.findall(r"^ {3}(recon .*\S) *$", help_of(*words), flags=re.MULTILINE)


@every_command
def test_it_shows_an_indented_example_of_that_command(words: tuple[str, ...]) -> None:
    examples = examples_of(words)
    assert examples
    assert all(example.startswith(" ".join(["recon", *words])) for example in examples)


@every_command
def test_its_examples_use_options_that_exist(words: tuple[str, ...]) -> None:
    options = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", help_of(*words).split("Options")[-1]))
    for example in examples_of(words):
        used = {word for word in shlex.split(example) if re.fullmatch(r"--?[a-z-]+", word)}
        assert used <= options, example


@every_command
def test_what_a_parameter_says_of_itself_is_all_shown(words: tuple[str, ...]) -> None:
    """Square brackets are markup to rich, which drops what it does not know."""
    squeezed = "".join(re.sub(r"[│\n]", " ", help_of(*words)).split())
    for parameter in _command(words).params:
        told = getattr(parameter, "help", None) or ""
        assert "".join(told.split()) in squeezed, parameter.name


@every_command
def test_its_text_fits_a_narrow_terminal(words: tuple[str, ...]) -> None:
    """Its line breaks are kept, so that a longer line would be broken twice."""
    margins = 2
    lines = inspect.cleandoc(_command(words).help or "").splitlines()[1:]
    assert max(map(len, lines)) <= 80 - margins


@every_command
@pytest.mark.parametrize("option", ["--json", "--quiet"])
def test_it_takes_what_every_command_takes(words: tuple[str, ...], option: str) -> None:
    assert option in {name for parameter in _command(words).params for name in parameter.opts}


def test_the_commands_are_grouped_by_what_they_are_for() -> None:
    shown = help_of()
    for title in ("Getting started", "Reconstruction", "Cameras", "Evaluation"):
        assert title in shown
