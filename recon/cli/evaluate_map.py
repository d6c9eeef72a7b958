"""`recon evaluate map`: compare a cloud with a reference cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli.options import Json, Quiet, parse_numbers
from recon.cli.session import session
from recon.cli.show.tables import print_evaluation, print_json


def map_(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or a PLY point cloud.")],
    reference: Annotated[Path, typer.Argument(help="Reference point cloud (PLY).")],
    reference_frame: Annotated[
        Literal["camera", "map"],
        typer.Option(help="Frame of REFERENCE: the first left camera, or the map."),
    ] = "camera",
    threshold: Annotated[
        str,
        typer.Option(
            help="Distance in metres up to which a point counts as correct; several with commas."
        ),
    ] = "0.2",
    align_to: Annotated[
        Path | None,
        typer.Option(
            help="Ground-truth poses (KITTI or TUM): align the path of the run, and the map with "
            "it, to these first."
        ),
    ] = None,
    align: Annotated[
        Literal["none", "icp"], typer.Option(help="Align the cloud to the reference with ICP.")
    ] = "none",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for clouds coloured by error.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare a map with a reference cloud: precision, recall and F-score.

    Nothing is aligned unless asked for. With --out, writes both clouds coloured
    by error.

    Examples:
      recon evaluate map outputs/map/latest lidar_map.ply --threshold 0.1,0.2,0.5
      recon evaluate map outputs/map/latest lidar_map.ply --align-to poses.txt
    """
    with session(quiet=quiet):
        from recon.commands.evaluate_map import run_evaluate_map

        figures = run_evaluate_map(
            run,
            reference,
            frame=reference_frame,
            align_to=align_to,
            icp=align == "icp",
            thresholds_m=parse_numbers(threshold, "--threshold") or (),
            out=out,
        )
    print_json(figures) if json else print_evaluation(f"{run} against {reference}", figures)
