"""`recon calibrate`: calibrate a rig from images of a board."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli import options as opt
from recon.cli.show.tables import print_json, print_run


@opt.takes_groups
def calibrate(
    left: Annotated[
        str,
        typer.Argument(
            help='Left images: a folder, a pattern in quotes such as "left*.png", or a video; or '
            "one video with both views."
        ),
    ],
    board: Annotated[
        str,
        typer.Option(
            help="chess:9x6:25mm (inner corners, square size) or "
            "charuco:8x6:30mm:22mm:5x5_100 (squares, square size, marker size, dictionary)."
        ),
    ],
    right: Annotated[
        str | None,
        typer.Argument(help="Right images, likewise.", show_default="both views are in LEFT"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Calibration file to write.")
    ] = None,
    form: Annotated[
        Literal["recon", "opencv", "ros", "kalibr"],
        typer.Option(
            "--format", "-f", help="Format of that file; ros writes two, _left and _right."
        ),
    ] = "recon",
    model: Annotated[
        Literal["radtan", "rational", "fisheye"] | None,
        typer.Option(
            help="Lens model: radtan, rational (wide angle) or fisheye (150 degrees or more).",
            show_default="radtan",
        ),
    ] = None,
    distance: Annotated[
        float | None,
        typer.Option(
            help="Distance in metres for which the verdict is made.",
            show_default="where matching errs by 2 %",
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the report, figures and pictures.",
            show_default="outputs/calibrate/<UTC time stamp>",
        ),
    ] = None,
    *,
    shared: opt.Shared,
) -> None:
    """Calibrate a stereo rig from images of a board, predict its depth error, and judge it.

    The verdict is good, usable or repeat, with what to do about it. Views that
    do not fit are dropped and named, repeated ones count once; intervals come
    from a bootstrap over the views. Good images: docs/board-capture.md.

    Examples:
      recon calibrate "left*.png" "right*.png" --board chess:9x6:25mm -o rig.yaml
      recon calibrate left/ right/ --board charuco:8x6:30mm:22mm:5x5_100
      recon calibrate both.mp4 --board chess:9x6:25mm
    """
    with shared.one_line_errors():
        from recon.commands.calibrate import run_calibrate
        from recon.commands.config import load_config
        from recon.core.values.board import parse_board
        from recon.io.atomic import check_targets
        from recon.rig.calibrate.result import describe_depths

        # kalibr's lens model has two radial terms.
        fitting = ["calibration.radial_terms=2"] if form == "kalibr" else []
        chosen = [] if model is None else [f"calibration.model={model}"]
        if distance is not None:
            chosen.append(f"calibration.working_m={distance}")
        if out is not None and shared.config is not None:
            check_targets([out], [shared.config])
        settings = load_config(shared.config, [*fitting, *shared.changes, *chosen])
        run = run_calibrate(
            left,
            right,
            parse_board(board),
            settings,
            file=out,
            form=form,
            out=report,
            threads=shared.threads,
        )
    if shared.json:
        print_json(run.summary)
    else:
        figures = run.summary | describe_depths(run.summary) | {"warnings": ()}
        print_run(figures, stages=shared.verbose)
        for finding in run.summary["findings"]:
            typer.echo(f"{finding['severity']}: {finding['text']}")
        typer.echo(f"verdict: {run.summary['verdict']}")
