"""The command line: parse, build the configuration, call one story of `commands/`, print one table.

`options.py` and `drive_options.py` have what several commands take: a dataclass is a group of
options, which `takes_groups` spreads. `errors.py` says what an error looks like; `tables.py` and
`progress.py` print.

Nothing heavy is imported before a command runs, so ``recon --help`` answers at once.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from recon import __version__
from recon.cli import datasets, evaluate
from recon.cli.batch import batch
from recon.cli.cameras import board, calibrate, rectify
from recon.cli.errors import interrupt_on_signals, report_unforeseen
from recon.cli.evaluate import paper
from recon.cli.getting_started import demo, doctor, settings
from recon.cli.live import live, localize
from recon.cli.map import map_, merge, piece
from recon.cli.options import Commands
from recon.cli.pair import disparity, pair
from recon.cli.products import export, mesh, occupancy
from recon.cli.recording import audit, capture

app = Commands(
    name="recon",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Stereo reconstruction and mapping: from image pairs to maps.\n\nStart with recon demo, "
    "which needs no data. recon COMMAND --help has examples.",
)
_START = "Getting started"
_RECONSTRUCT = "Reconstruction and mapping"
_CAMERAS = "Cameras and recordings"
_EVALUATE = "Evaluation"

app.command(rich_help_panel=_START)(demo)
app.command(rich_help_panel=_START)(doctor)
app.command(rich_help_panel=_START)(settings)
app.command(rich_help_panel=_RECONSTRUCT)(pair)
app.command(rich_help_panel=_RECONSTRUCT)(disparity)
app.command("map", rich_help_panel=_RECONSTRUCT)(map_)
app.command(rich_help_panel=_RECONSTRUCT)(localize)
app.command(rich_help_panel=_RECONSTRUCT)(live)
app.command(rich_help_panel=_RECONSTRUCT)(merge)
app.command(rich_help_panel=_RECONSTRUCT)(export)
app.command(rich_help_panel=_RECONSTRUCT)(mesh)
app.command(rich_help_panel=_RECONSTRUCT)(occupancy)
app.command(rich_help_panel=_RECONSTRUCT)(batch)
app.command(rich_help_panel=_CAMERAS)(board)
app.command(rich_help_panel=_CAMERAS)(calibrate)
app.command(rich_help_panel=_CAMERAS)(rectify)
app.command(rich_help_panel=_CAMERAS)(capture)
app.command(rich_help_panel=_CAMERAS)(audit)
app.add_typer(datasets.app, name="datasets", rich_help_panel=_CAMERAS)
app.add_typer(evaluate.app, name="evaluate", rich_help_panel=_EVALUATE)
app.command(rich_help_panel=_EVALUATE)(paper)
app.command(hidden=True)(piece)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"recon {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Hold the options of the program itself."""


def main() -> None:
    """Run the program; a request to end it is an interruption, after which nothing half is left."""
    _open_standard_streams()
    interrupt_on_signals()
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
