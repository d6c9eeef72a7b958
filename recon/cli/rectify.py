"""`recon rectify`: rectify images so that rows correspond."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt


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
        from recon.commands.config import load_config
        from recon.commands.rectify import run_rectify

        run = run_rectify(
            left,
            right,
            load_config(shared.config, shared.changes),
            calibration=calib,
            metres_per_unit=unit_m,
            out=out,
            threads=shared.threads,
        )
    shared.show(run.summary)
