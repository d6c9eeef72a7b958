"""`recon piece`: what a worker of `recon map --workers` runs; not for people."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.show.tables import print_json, print_run


def piece(
    plan: Annotated[Path, typer.Argument(help="Plan of the pieces, in the folder of the run.")],
    number: Annotated[int, typer.Argument(help="Number of the piece.")],
    out: Annotated[Path | None, typer.Option(help="New folder of the piece.")] = None,
    resume: Annotated[Path | None, typer.Option(help="Folder of one to go on with.")] = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
    threads: opt.Threads = None,
) -> None:
    """Map one piece of a drive, or go on with it.

    The workers of recon map --workers run this. Its result is the map of the
    piece, which that command joins with the others.

    Examples:
      recon piece outputs/long/.partial/.state/pieces.json 0 --out piece0
    """
    folder = resume or out
    if folder is None:
        raise typer.BadParameter("give --out FOLDER or --resume FOLDER")
    with one_line_errors(quiet=quiet):
        from recon.cli.show.progress import choose_viewer
        from recon.commands.piece import run_piece

        viewer = choose_viewer(quiet=quiet, verbose=verbose)
        going_on = resume is not None
        summary = run_piece(plan, number, folder, resume=going_on, threads=threads, progress=viewer)
    print_json(summary) if json else print_run(summary, stages=verbose)
