"""`recon board`: a calibration board to print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.show.tables import print_figures, print_json


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
