"""`recon demo`: the whole pipeline on a rendered street, compared with ground truth."""

from __future__ import annotations

from typing import Annotated

import typer

from recon.cli import options as opt


@opt.takes_groups
def demo(
    out: opt.Out = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of frames.", show_default="40")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the street.", show_default="0")
    ] = None,
    mesh: opt.Mesh = True,
    *,
    shared: opt.Shared,
) -> None:
    """Render a synthetic street drive, map it and compare the result with the truth.

    Needs no data. The results are those of recon map.

    Examples:
      recon demo
      recon demo --frames 60 --seed 3 --out outputs/street
    """
    with shared.one_line_errors():
        from recon.commands.config import load_config
        from recon.commands.demo import run_demo

        given = {"frames": frames, "seed": seed}
        overrides = [f"street.{key}={value}" for key, value in given.items() if value is not None]
        settings = load_config(shared.config, [*shared.changes, *overrides])
        viewer = shared.viewer()
        run = run_demo(settings, out=out, mesh=mesh, threads=shared.threads, progress=viewer)
    shared.show(run.summary)
