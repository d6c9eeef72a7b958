"""A command that has to wait for the compiler says so, once and on a terminal alone."""

from __future__ import annotations

import io

import pytest

from recon.cli.errors import one_line_errors
from recon.core.kernels.cache import announce


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(
    monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, *, quiet: bool = False
) -> list[str]:
    """What standard error gets while a command meets two kernels that are not compiled."""
    monkeypatch.setattr("sys.stderr", stream)
    with one_line_errors(quiet=quiet):
        announce("first")
        announce("second")
    return stream.getvalue().splitlines()


def test_it_is_one_line_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = shown(monkeypatch, Terminal())
    assert line.startswith("compiling kernels, once")


def test_it_is_no_line_in_a_pipe_or_where_progress_is_not_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert shown(monkeypatch, io.StringIO()) == []
    assert shown(monkeypatch, Terminal(), quiet=True) == []
