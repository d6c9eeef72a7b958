"""Runs commands on hostile input and checks how they refuse it."""

import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from typer.testing import CliRunner

import recon
from recon.cli import app
from recon.core.errors import ReconError


@dataclass(frozen=True)
class Ended:
    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """Lines on standard error, without progress events and notes."""
        notes = ("{", "reading ", "warning: ")
        return [line for line in self.err.splitlines() if not line.startswith(notes)]


def run(*arguments: str | Path) -> Ended:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", ResourceWarning)  # of whatever ran before
        result = CliRunner().invoke(app, [os.fspath(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    # What a library would print as a warning is a line too many for the user.
    extra = "".join(f"{note.category.__name__}: {note.message}\n" for note in told)
    return Ended(result.exit_code, result.stdout, result.stderr + extra)


def run_apart(*arguments: str | Path) -> Ended:
    """Run a command in a process of its own, which may crash, or hang as long as a test may take.

    How long it takes says nothing: that depends on what the machine does beside it.
    """
    command = [sys.executable, "-m", "recon", *map(os.fspath, arguments)]
    # The program of this checkout, wherever the command runs.
    surroundings = os.environ | {"PYTHONPATH": str(Path(recon.__file__).parents[1])}
    done = subprocess.run(command, capture_output=True, check=False, env=surroundings)
    return Ended(done.returncode, done.stdout.decode(), done.stderr.decode())


def refusal(read: Callable[[], object]) -> str | None:
    """The line by which our error refuses some input, None if it is accepted; no other error."""
    try:
        read()
    except ReconError as error:
        line = str(error)
    else:
        return None
    assert len(line) < 1000, line
    return line


def assert_refused(ended: Ended, *words: str) -> None:
    """Assert exit code 1, nothing on standard output, and one line that has the words."""
    assert ended.code == 1, (ended.code, ended.err, ended.out)
    assert ended.out == ""
    assert len(ended.lines) == 1, ended.err
    (line,) = ended.lines
    assert line.startswith("error: "), line
    assert len(line) < 1000, line
    assert "Traceback" not in line
    assert "internal error" not in line
    for word in words:
        assert word in line, line
