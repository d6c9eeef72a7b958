"""Shared by all commands: clean standard output, one-line errors, exit codes.

0 = success, 1 = an error reported in one line, 2 = wrong usage (typer), 3 = a bug of recon, also in
one line, 130 = interrupted (Ctrl-C, SIGTERM, SIGHUP).
"""

from __future__ import annotations

import io
import os
import resource
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import typer

from recon.core.errors import MissingDependencyError, ReconError, SettingsError

INTERRUPTED = 130
_BUG = 3
_ADDRESS_BYTES = 2_500_000_000
"""What the libraries of a command reserve, most of it never used: 1.8 to 2.2 GB were seen."""


@contextmanager
def one_line_errors(*, quiet: bool = False, verbose: bool = False) -> Iterator[None]:
    """Run a command's body, shown; a `ReconError` becomes one line on standard error and code 1.

    Any other exception is a bug: one line with the file that has its traceback, and exit code 3.
    Meanwhile file descriptor 1 is redirected to standard error, so that the output of native
    libraries cannot get into that of ``--json``; with ``quiet`` that output is dropped, and nothing
    is shown of what is done.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # bytes of file names may not be UTF-8
            stream.reconfigure(errors="backslashreplace")
    try:
        _check_surroundings()
        from recon.cli.progress import watched

        with (
            warnings.catch_warnings(),
            _standard_output_kept_clean(quiet),
            watched(quiet=quiet, verbose=verbose),
        ):
            warnings.showwarning = lambda *_, **__: None  # of libraries: no user can act on them
            yield
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except ReconError as error:
        _fail(str(error))
    except MemoryError:
        _fail("out of memory; use smaller images, fewer disparities or a coarser map")
    except ImportError as error:
        # Ctrl-C while a native library initialises surfaces as an import failure.
        if not _interrupted(error):
            raise typer.Exit(report_unforeseen(error)) from None
        typer.echo("interrupted", err=True)
        raise typer.Exit(INTERRUPTED) from None
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        _fail(f"{name}{error.strerror or error}")
    except KeyboardInterrupt as interrupt:
        typer.echo("; ".join(["interrupted", *map(str, interrupt.args)]), err=True)
        raise typer.Exit(INTERRUPTED) from None
    except SystemExit as ended:  # whatever code it gave, there is no result
        _fail(f"a package that recon uses ended the program (sys.exit({ended.code!r}))")
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a bug
        raise typer.Exit(report_unforeseen(error)) from None


def _check_surroundings() -> None:
    """Refuse limits under which libraries would fail, or crash, while they are loaded."""
    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    if not (threads.isdecimal() and threads.isascii() and int(threads) > 0):
        where, expected = "NUMBA_NUM_THREADS", "a positive number"
        raise SettingsError("not a number of threads", where=where, got=threads, expected=expected)
    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit_bytes != resource.RLIM_INFINITY and limit_bytes < _ADDRESS_BYTES:
        got, least = f"{limit_bytes / 1e6:.0f} MB", f"at least {_ADDRESS_BYTES / 1e6:.0f} MB"
        what = "too little address space for the libraries"
        hint = "raise it, and bound memory with --memory-limit"
        raise SettingsError(what, where="ulimit -v", got=got, expected=least, hint=hint)


def report_unforeseen(error: BaseException) -> int:
    """Print one line for an exception that nothing has caught, and return the exit code.

    A package of others that cannot be imported is a fault of the installation. All else should not
    have happened: its traceback goes to a new file in the folder for temporary files.
    """
    if isinstance(error, ImportError) and (error.name or "").partition(".")[0] != "recon":
        what, hint = "a package cannot be imported", "recon doctor says what is missing"
        typer.echo(f"error: {MissingDependencyError(what, got=error, hint=hint)}", err=True)
        return 1
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="recon-error-", suffix=".txt", delete=False, errors="backslashreplace"
        ) as file:
            file.write(" ".join(sys.argv) + "\n")
            traceback.print_exception(error, file=file)
        where = file.name
    except OSError:
        where = "(no folder for temporary files can be written; set TMPDIR for the traceback)"
    what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    typer.echo(f"error: internal error ({what}), please report: {where}", err=True)
    return _BUG


@contextmanager
def _standard_output_kept_clean(quiet: bool) -> Iterator[None]:
    sys.stdout.flush()
    saved = os.dup(1)
    instead = os.open(os.devnull, os.O_WRONLY) if quiet else os.dup(2)
    os.dup2(instead, 1)
    os.close(instead)
    try:
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)


def _interrupted(error: BaseException) -> bool:
    earlier = error.__cause__ or error.__context__
    if earlier is None:
        return isinstance(error, KeyboardInterrupt)
    return isinstance(error, KeyboardInterrupt) or _interrupted(earlier)


def _fail(line: str) -> None:
    typer.echo(f"error: {line}", err=True)
    raise typer.Exit(1) from None


_AGAIN_S: Final = 0.1


def interrupt_on_signals() -> None:
    """Let a request to end the program interrupt it, as Ctrl-C does, wherever it is."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # else nohup has it ignored
            signal.signal(number, signal.default_int_handler)
    show = sys.unraisablehook

    def interrupt_again(lost: sys.UnraisableHookArgs) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            # In a callback, as of a weak reference, Python drops it; at once it would be here, too.
            signal.signal(signal.SIGALRM, signal.default_int_handler)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        else:
            show(lost)

    sys.unraisablehook = interrupt_again


@contextmanager
def until_interrupted() -> Iterator[Callable[[], bool]]:
    """Yield a test for SIGINT or SIGTERM; a second signal ends the program at once."""
    asked = threading.Event()
    before = {int(n): signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, frame: object) -> None:
        del frame
        asked.set()
        signal.signal(number, before[number])

    for number in before:
        signal.signal(number, note)
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
