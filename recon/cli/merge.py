"""`recon merge`: one map of several runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.session import session
from recon.cli.show.tables import print_json, print_run


def merge(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN RUN...", help="Folders of finished runs, the oldest first."),
    ],
    out: opt.Out = None,
    mesh: opt.Mesh = True,
    config: opt.Config = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
    threads: opt.Threads = None,
) -> None:
    """Make one map of several runs: linked by places that two of them saw.

    Cloud, grid, OctoMap and mesh are made of all drives that are linked with
    the first. What a later run saw free loses what an earlier one saw there.
    Drives that share no place are kept apart, and named.

    Examples:
      recon merge outputs/monday outputs/friday --out outputs/week
      recon merge outputs/week outputs/sunday --no-mesh
    """
    with session(quiet=quiet):
        from recon.cli.show.progress import choose_viewer
        from recon.commands.config import run_settings
        from recon.commands.map_options import MapOptions
        from recon.commands.merge import run_merge

        settings = run_settings(runs[0], config, set_ or ())
        viewer = choose_viewer(quiet=quiet, verbose=verbose)
        options = MapOptions("merge", out, threads, mesh=mesh, progress=viewer)
        summary = run_merge(runs, settings, options)
    print_json(summary) if json else print_run(summary, stages=verbose)
