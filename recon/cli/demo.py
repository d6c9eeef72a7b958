"""`recon demo`: the whole pipeline on a rendered street, compared with ground truth."""

from __future__ import annotations

from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.session import session
from recon.cli.show.tables import print_json, print_run


def demo(
    out: opt.Out = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of frames.", show_default="40")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the street.", show_default="0")
    ] = None,
    mesh: opt.Mesh = True,
    config: opt.Config = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
    threads: opt.Threads = None,
) -> None:
    """Render a synthetic street drive, map it and compare the result with the truth.

    Needs no data. The results are those of recon map.

    Examples:
      recon demo
      recon demo --frames 60 --seed 3 --out outputs/street
    """
    with session(quiet=quiet):
        from recon.cli.show.progress import choose_viewer
        from recon.commands.config import load_config
        from recon.commands.demo import run_demo

        given = {"frames": frames, "seed": seed}
        overrides = [f"street.{key}={value}" for key, value in given.items() if value is not None]
        settings = load_config(config, [*(set_ or ()), *overrides])
        viewer = choose_viewer(quiet=quiet, verbose=verbose)
        run = run_demo(settings, out=out, mesh=mesh, threads=threads, progress=viewer)
    print_json(run.summary) if json else print_run(run.summary, stages=verbose)
