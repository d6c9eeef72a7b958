"""Maps in the browser: `recon view`, and ``--view`` of commands that make a map."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors, until_interrupted
from recon.cli.tables import print_json

View = Annotated[bool, opt.option("Show map and path in the browser while they grow (extra view).")]
Runs = Annotated[
    list[Path],
    typer.Argument(metavar="RUN...", help="Runs that made or make a map, or found a drive in one."),
]
PORT: Final = 8080
Port = Annotated[int, opt.option("Port of this machine; 0 = any that is free.", min=0, max=65535)]
_LEAST_PRIORITY: Final = 19
Beside = Annotated[int | None, typer.Option(hidden=True)]


def view(
    runs: Runs,
    port: Port = PORT,
    georeference: Annotated[
        Path | None, opt.option("Control points, to be clicked in keyframes of the runs.")
    ] = None,
    crs: Annotated[
        str | None, opt.option("Coordinate system of the control points, such as EPSG:25832.")
    ] = None,
    beside: Beside = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Look at maps in the browser: points, grid, mesh, path, keyframes.

    For this machine alone, at a secret address, until Ctrl-C. Runs that are being
    made grow; a click shows which keyframes saw a place, and what they saw.

    Examples:
      recon view outputs/map/latest
      recon view outputs/monday outputs/friday --port 8090
      recon view outputs/site --georeference gcp_list.txt
    """
    with until_interrupted() as stopped, one_line_errors(quiet=quiet or beside is not None):
        if beside is not None:
            os.nice(_LEAST_PRIORITY)
        from recon.commands.view import run_view
        from recon.core.progress import stage

        ends = "Ctrl-C" if beside is None else "the run ends"

        def announce(url: str) -> None:  # also where it is quiet: nobody can guess the address
            stage("")  # what follows is up to who looks
            typer.echo(f"{url} until {ends}", err=True)

        def over() -> bool:
            return stopped() or beside not in (None, os.getppid())

        url = run_view(runs, port, announce, over, opt.survey_of(georeference, None, crs))
    if json:
        print_json({"url": url})


def view_beside(run: Path) -> None:
    """Show a run while it lasts, in a process that gets the time that is left.

    It says its address, and what goes wrong; either way the run goes on.
    """
    words = ["view", str(run), "--port", str(PORT), "--beside", str(os.getpid())]
    quiet = subprocess.DEVNULL
    subprocess.Popen([sys.executable, "-m", "recon", *words], stdin=quiet, stdout=quiet)
