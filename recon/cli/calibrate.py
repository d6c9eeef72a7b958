"""`recon calibrate`: pictures of a board in, a calibration file out."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import Config, Json, Quiet, Set, Threads, Verbose
from recon.cli.session import print_json, print_run, session


class Model(str, Enum):
    """Lens models."""

    radtan = "radtan"
    rational = "rational"
    fisheye = "fisheye"


class Form(str, Enum):
    """Formats of calibration files."""

    recon = "recon"
    opencv = "opencv"
    ros = "ros"
    kalibr = "kalibr"


def calibrate(
    left: Annotated[
        str, typer.Argument(help='Left pictures: a folder, or a pattern in quotes, "left*.png".')
    ],
    right: Annotated[str, typer.Argument(help="Right pictures, likewise.")],
    board: Annotated[
        str,
        typer.Option(
            help="chess:9x6:25mm (inner corners, side of a square), or "
            "charuco:8x6:30mm:22mm:5x5_100 (squares, square, marker, dictionary)."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Calibration file to write.")
    ] = None,
    form: Annotated[
        Form, typer.Option("--format", "-f", help="Of that file; ros writes two, _left and _right.")
    ] = Form.recon,
    model: Annotated[
        Model | None,
        typer.Option(
            help="Lens: radtan (default), rational (wide), fisheye (150 degrees or more)."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Folder of report, pictures, figures (outputs/calibrate/<UTC stamp>)."),
    ] = None,
    config: Config = None,
    set_: Set = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    threads: Threads = None,
) -> None:
    """Calibrate two cameras from pictures of a board, and say what depth will be worth.

    Example: recon calibrate "left*.png" "right*.png" --board chess:9x6:25mm --out rig.yaml
    """
    del quiet  # there is no progress to hide; every command takes the option
    with session():
        from recon.pipeline.calibrate_run import CalibrateOptions, run_calibration
        from recon.pipeline.calibrate_summary import tell_depths
        from recon.pipeline.config import load_config
        from recon.reports import present_calibration
        from recon.structures.board import parse_board

        # kalibr has two radial terms.
        fitting = ["calibration.radial_terms=2"] if form is Form.kalibr else []
        chosen = [] if model is None else [f"calibration.model={model.value}"]
        settings = load_config(config, [*fitting, *(set_ or ()), *chosen])
        options = CalibrateOptions(out, form.value, report, threads, present_calibration)
        run = run_calibration(left, right, parse_board(board), settings, options)
    if json:
        print_json(run.summary)
    else:
        print_run(run.summary | tell_depths(run.summary), stages=verbose)
