"""Maps in the browser: `recon view`, and ``--view`` of commands that make a map."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors, until_interrupted
from recon.cli.tables import print_json

View = Annotated[bool, opt.option("Show map and path in the browser while they grow (extra view).")]
Runs = Annotated[
    list[Path],
    typer.Argument(metavar="RUN...", help="Runs that made or make a map, or found a drive in one."),
]
Port = Annotated[int, opt.option("Port of this machine; 0 = any that is free.", min=0, max=65535)]
Beside = Annotated[int | None, typer.Option(hidden=True)]


def view(
    runs: Runs,
    port: Port = 8080,
    beside: Beside = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Look at maps in the browser: points, grid, mesh, path, keyframes.

    For this machine alone, until Ctrl-C. Runs that are being made grow; a click
    shows which keyframes saw a place, and what they saw.

    Examples:
      recon view outputs/map/latest
      recon view outputs/monday outputs/friday --port 8090
    """
    with until_interrupted() as stopped, one_line_errors(quiet=quiet):
        from recon.commands.view import run_view

        say = str if quiet else partial(typer.echo, err=True)
        url = run_view(runs, port, say, lambda: stopped() or beside not in (None, os.getppid()))
    if json:
        print_json({"url": url})


def view_beside(run: Path) -> None:
    """Show the map of a run in a process that ends with this one, and may fail without harm."""
    words = [sys.executable, "-m", "recon", "view", str(run), "--beside", str(os.getpid())]
    with suppress(OSError):
        viewer = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        os.setpriority(os.PRIO_PROCESS, viewer.pid, 19)  # it gets the time that is left
