"""`recon evaluate map`: a cloud against a reference cloud."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import Json, parse_numbers
from recon.cli.session import print_evaluation, print_json, session


class ReferenceFrame(str, Enum):
    """Axes of a reference cloud."""

    camera = "camera"
    map = "map"


class MapAlignment(str, Enum):
    """How a cloud is laid onto its reference."""

    none = "none"
    icp = "icp"


def map_(
    run: Annotated[Path, typer.Argument(help="A run's folder, or a PLY.")],
    reference: Annotated[Path, typer.Argument(help="PLY that is taken as true.")],
    reference_frame: Annotated[
        ReferenceFrame, typer.Option(help="Axes of REFERENCE: first left camera, or map.")
    ] = ReferenceFrame.camera,
    threshold: Annotated[
        str, typer.Option(help="Metres below which a point is right; several, with commas.")
    ] = "0.2",
    align_to: Annotated[
        Path | None,
        typer.Option(help="True poses (KITTI or TUM): the run's path is moved to lie closest."),
    ] = None,
    align: Annotated[
        MapAlignment, typer.Option(help="Lay the cloud onto the reference by ICP.")
    ] = MapAlignment.none,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for clouds coloured by error.")
    ] = None,
    json: Json = False,
) -> None:
    """Precision, recall and F-score of a cloud against a reference cloud.

    Examples:
      recon evaluate map outputs/map/latest lidar_map.ply --threshold 0.1,0.2,0.5
      recon evaluate map outputs/map/latest lidar_map.ply --align-to poses.txt --out outputs/errors
    """
    with session():
        from recon.pipeline.evaluate_map import MapFiles, run_evaluate_map
        from recon.reports.map_errors import present_map_errors

        files = MapFiles(
            run=run,
            reference=reference,
            frame=reference_frame.value,
            align_to=align_to,
            icp=align is MapAlignment.icp,
            thresholds_m=parse_numbers(threshold, "--threshold") or (),
        )
        figures = run_evaluate_map(files, out, present_map_errors)
    print_json(figures) if json else print_evaluation(f"{run} against {reference}", figures)
