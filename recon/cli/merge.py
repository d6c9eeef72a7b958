"""`recon merge`: one map of several runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt


@opt.takes_groups
def merge(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN RUN...", help="Folders of finished runs, the oldest first."),
    ],
    out: opt.Out = None,
    mesh: opt.Mesh = True,
    *,
    shared: opt.Shared,
) -> None:
    """Make one map of several runs: linked by places that two of them saw.

    Cloud, grid, OctoMap and mesh are made of all drives that are linked with
    the first. What a later run saw free loses what an earlier one saw there.
    Drives that share no place are kept apart, and named.

    Examples:
      recon merge outputs/monday outputs/friday --out outputs/week
      recon merge outputs/week outputs/sunday --no-mesh
    """
    with shared.one_line_errors():
        from recon.commands.config import run_settings
        from recon.commands.map_options import MapOptions
        from recon.commands.merge import run_merge

        settings = run_settings(runs[0], shared.config, shared.changes)
        viewer = shared.viewer()
        options = MapOptions("merge", out, shared.threads, mesh=mesh, progress=viewer)
        summary = run_merge(runs, settings, options)
    shared.show(summary)
