"""`recon evaluate`: results against truth."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from recon.cli.evaluate_disparity import disparity
from recon.cli.evaluate_middlebury import middlebury
from recon.cli.evaluate_occupancy import occupancy
from recon.cli.evaluate_trajectory import trajectory
from recon.cli.options import Json
from recon.cli.session import print_figures, print_json, session

app = typer.Typer(no_args_is_help=True, help="Compare results with truth.")
app.command()(middlebury)
app.command()(disparity)
app.command()(trajectory)
app.command()(occupancy)


class ReferenceFrame(str, Enum):
    """Axes of a reference cloud."""

    camera = "camera"
    map = "map"


@app.command("map")
def map_(
    run: Annotated[Path, typer.Argument(help="A run's folder, or a PLY.")],
    reference: Annotated[Path, typer.Argument(help="PLY that is taken as true.")],
    reference_frame: Annotated[
        ReferenceFrame, typer.Option(help="Axes of REFERENCE: first left camera, or map.")
    ] = ReferenceFrame.camera,
    threshold: Annotated[
        float, typer.Option(help="Distance in metres below which a point is right.")
    ] = 0.2,
    json: Json = False,
) -> None:
    """Precision, recall and F-score of a cloud against a reference cloud.

    Example: recon evaluate map outputs/map/latest lidar_map.ply --threshold 0.2
    """
    with session():
        from recon.pipeline.evaluate_run import compare_maps

        figures = compare_maps(run, reference, frame=reference_frame.value, threshold_m=threshold)
    print_json(figures) if json else print_figures(f"{run} against {reference}", figures)
