"""`recon calibrate`: calibrate a rig from images of a board."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.tables import print_figures, print_json, print_run


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
        opt.setting(
            "calibration.model",
            help="Lens model: radtan, rational (wide angle) or fisheye (150 degrees or more).",
            show_default="radtan",
        ),
    ] = None,
    distance: Annotated[
        float | None,
        opt.setting(
            "calibration.working_m",
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
    from a bootstrap over the views. Good images: docs/calibration.md.

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
        if out is not None and shared.config is not None:
            check_targets([out], [shared.config])
        settings = load_config(shared.config, [*fitting, *shared.changes])
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


def board(
    pattern: Annotated[
        str | None,
        typer.Argument(
            metavar="BOARD",
            help="chess:9x6:25mm (inner corners, square size) or "
            "charuco:8x6:30mm:22mm:5x5_100 (squares, square size, marker size, dictionary).",
        ),
    ] = None,
    same: Annotated[
        str | None, typer.Option("--board", help="The board as an option, as in recon calibrate.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="PDF or PNG file to write.")] = Path(
        "board.pdf"
    ),
    paper: Annotated[
        str | None,
        typer.Option(
            help="a4, a3, a2, a1, a0, letter, legal, tabloid, or a size such as 600x400mm.",
            show_default="smallest A size that fits",
        ),
    ] = None,
    dpi: Annotated[
        float,
        typer.Option(min=30, max=2400, help="Approximate resolution of a PNG, in pixels per inch."),
    ] = 300.0,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Draw a calibration board to scale, for printing.

    Print it at 100 % and check the ruler on it before use.

    Examples:
      recon board chess:9x6:25mm --out board.pdf --paper a4
      recon board charuco:8x6:30mm:22mm:5x5_100 --out charuco.png
    """
    wanted = pattern or same
    if wanted is None or (pattern and same):
        raise typer.BadParameter("name one board, such as chess:9x6:25mm")
    with one_line_errors(quiet=quiet):
        from recon.core.values.board import parse_board
        from recon.rig.board_sheet import write_board

        figures = write_board(out, parse_board(wanted), paper, dpi)
    print_json(figures) if json else print_figures("", figures)


@opt.takes_groups
def rectify(
    left: Annotated[
        str, typer.Argument(help='Left image, folder, or pattern in quotes such as "left*.png".')
    ],
    right: Annotated[str, typer.Argument(help="Right image, folder or pattern.")],
    calib: Annotated[
        Path | None,
        typer.Option(
            help="Calibration of the raw cameras. Without one, homographies are estimated from "
            "image features, and depth has no scale."
        ),
    ] = None,
    unit_m: Annotated[
        float, typer.Option(min=1e-6, help="Metres per unit in an OpenCV file, e.g. 0.001 for mm.")
    ] = 1.0,
    out: opt.Out = None,
    *,
    shared: opt.Shared,
) -> None:
    """Rectify a pair or two folders of images, with or without a calibration.

    Writes the rectified images, the remaining row error, and pictures with
    epipolar lines.

    Examples:
      recon rectify left/ right/ --calib rig.yaml --out rectified
      recon rectify left.png right.png
    """
    with shared.one_line_errors():
        from recon.commands.calibrate import run_rectify

        run = run_rectify(
            left,
            right,
            shared.settings(),
            calibration=calib,
            metres_per_unit=unit_m,
            out=out,
            threads=shared.threads,
        )
    shared.show(run.summary)
