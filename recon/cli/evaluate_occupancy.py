"""`recon evaluate occupancy`: compare voxels and grid of a run with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import Json, Quiet
from recon.cli.session import session
from recon.cli.show.tables import print_figures, print_json


def occupancy(
    run: Annotated[Path, typer.Argument(help="Folder of a recon demo run.")],
    least_frames: Annotated[
        int, typer.Option(min=1, help="Compare only what at least this many frames saw.")
    ] = 3,
    picture: Annotated[
        Path | None, typer.Option(help="PNG to draw: the grid with its errors in colour.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare voxels and grid of a demo run with the exact truth.

    Precision and recall of occupied voxels; intersection over union of the
    grid.

    Examples:
      recon evaluate occupancy outputs/demo/latest --picture compared.png
    """
    with session(quiet=quiet):
        from recon.commands.evaluate_occupancy import run_evaluate_occupancy
        from recon.run.summary import plain

        compared = run_evaluate_occupancy(run, least_frames, image=picture)
        figures = plain(compared.metrics)
    if json:
        print_json(figures)
        return
    shown = {
        f"{part} {name}": value
        for part, values in figures.items()
        if isinstance(values, dict)
        for name, value in values.items()
    }
    print_figures(f"{run} against the true street", shown)
