"""The command line: parse, build the configuration, call one story of `commands/`, print one table.

`options.py` and `drive_options.py` have what several commands take: a dataclass is a group of
options, which `takes_groups` spreads. `errors.py` says what an error looks like; `tables.py` and
`progress.py` print.

Nothing heavy is imported before a command runs, so ``recon --help`` answers at once.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import Annotated, Final

import typer

from recon import __version__
from recon.cli.batch import batch
from recon.cli.cameras import audit, board, calibrate, capture, rectify
from recon.cli.errors import interrupt_on_signals, report_unforeseen
from recon.cli.evaluate import app as evaluate
from recon.cli.evaluate import paper
from recon.cli.getting_started import datasets, demo, doctor, settings
from recon.cli.map import diff, live, localize, map_, merge, piece
from recon.cli.options import Commands, option
from recon.cli.pair import disparity, pair
from recon.cli.products import export, mesh, occupancy, volume
from recon.cli.view import view

app = Commands(
    name="recon",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Stereo reconstruction and mapping: from image pairs to maps.\n\nStart with recon demo, "
    "which needs no data. recon COMMAND --help has examples.",
)
_PANELS: Final = {
    "Getting started": (demo, doctor, settings),
    "Reconstruction and mapping": (
        pair, disparity, map_, localize, live, merge, diff, view, export, mesh, occupancy,
        volume, batch,
    ),
    "Cameras and recordings": (board, calibrate, rectify, capture, audit, datasets),
    "Evaluation": (evaluate, paper),
}  # fmt: skip
for _panel, _commands in _PANELS.items():
    for _command in _commands:
        if isinstance(_command, Commands):
            app.add_typer(_command, rich_help_panel=_panel)
        else:
            app.command(_command.__name__.rstrip("_"), rich_help_panel=_panel)(_command)
app.command(hidden=True)(piece)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"recon {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, option("Print the version.", "--version", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Hold the options of the program itself."""


def main() -> None:
    """Run the program; a request to end it is an interruption, after which nothing half is left."""
    _open_standard_streams()
    interrupt_on_signals()
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it says where its cache is
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what is left in the buffer
        if not isinstance(error, BrokenPipeError):  # as by `| head`
            typer.echo(f"error: the output cannot be written ({error.strerror})", err=True)
        sys.exit(1)
    except Exception as error:  # noqa: BLE001 - outside of `one_line_errors`, as while printing a table
        sys.exit(report_unforeseen(error))


def _open_standard_streams() -> None:
    """Put the null device where a standard stream is closed: a file would take its number."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
