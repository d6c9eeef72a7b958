"""`recon paper`: repeat the experiments of the seed paper, with its misprints corrected."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt


@opt.takes_groups
def paper(
    scenes: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with the Middlebury scenes ArtL, Jadeplant and Pipes at quarter size.",
            show_default="$RECON_DATA/middlebury/MiddEval3/trainingQ",
        ),
    ] = None,
    as_printed: Annotated[
        bool,
        opt.setting(
            "paper.as_printed",
            "--as-printed",
            help="Also run the method as printed, and compare the two.",
        ),
    ] = False,
    out: opt.Out = None,
    *,
    shared: opt.Shared,
) -> None:
    """Repeat experiments 2 to 4 of the paper that this project is based on.

    Writes disparity and depth maps, surfaces, clouds, depth curves, Table 1 and
    a report. What the paper misprints, and how it is corrected: docs/paper.md.

    Examples:
      recon paper MiddEval3/trainingQ
      recon paper MiddEval3/trainingQ --as-printed --out outputs/paper-as-printed
    """
    with shared.one_line_errors():
        from recon.commands.config import PAIR_DEFAULTS
        from recon.commands.paper import headline, run_paper

        settings = shared.settings(PAIR_DEFAULTS)
        summary = run_paper(scenes, settings, out=out, threads=shared.threads)
    shared.show(summary if shared.json else {**headline(summary), **summary})
