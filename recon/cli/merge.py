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
        typer.Argument(
            metavar="RUN RUN...",
            help="Folders of finished runs, the oldest first; with --georeference, one will do.",
        ),
    ],
    out: opt.Out = None,
    georeference: Annotated[
        Path | None,
        typer.Option(
            help="Measured positions, which the paths are bent to run through: rows of time, "
            "easting, northing and height (s, m), on the clock of the images.",
            show_default="none",
        ),
    ] = None,
    antenna: opt.Antenna = None,
    mesh: opt.Mesh = True,
    *,
    shared: opt.Shared,
) -> None:
    """Make one map of several runs: linked by places that two saw, or by measured positions.

    Cloud, grid, OctoMap and mesh are made of all drives that are linked with
    the first. What a later run saw free loses what an earlier one saw there.
    Drives that share no place are kept apart, and named. Positions that were
    measured along drives, by GNSS or a total station, take the drift out of their
    paths, and place drives that share no place.

    Examples:
      recon merge outputs/monday outputs/friday --out outputs/week
      recon merge outputs/week outputs/sunday --no-mesh
      recon merge outputs/site --georeference gnss.txt --antenna=-0.4,0.1,0.7
    """
    with shared.one_line_errors():
        from recon.commands.config import run_settings
        from recon.commands.merge import run_merge

        settings = run_settings(runs[0], shared.config, shared.changes)
        options = shared.options("merge", out, mesh=mesh)
        summary = run_merge(runs, settings, options, opt.survey_of(georeference, antenna))
    shared.show(summary)
