"""`recon evaluate trajectory`: a path against the true one."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import Json, parse_numbers
from recon.cli.session import print_evaluation, print_json, session


class Alignment(str, Enum):
    """What is done to the estimate before it is compared."""

    none = "none"
    origin = "origin"
    se3 = "se3"
    sim3 = "sim3"


def trajectory(
    estimate: Annotated[Path, typer.Argument(help="KITTI or TUM trajectory of a run.")],
    truth: Annotated[Path, typer.Argument(help="The true one, in either format.")],
    align: Annotated[
        Alignment,
        typer.Option(help="Move the estimate: not, to the first pose, rigidly, or with scale."),
    ] = Alignment.se3,
    lengths: Annotated[
        str | None,
        typer.Option(help="Lengths of KITTI's segments in metres. [default: told by the path]"),
    ] = None,
    step: Annotated[
        int | None, typer.Option(help="Frames from segment to segment. [default: 10]")
    ] = None,
    rpe_frames: Annotated[int, typer.Option(help="Frames apart for the RPE.")] = 1,
    times: Annotated[
        Path | None, typer.Option(help="Seconds of the poses of a KITTI file, one a line.")
    ] = None,
    tolerance: Annotated[
        float, typer.Option(min=0, help="Seconds that the times of two poses may differ.")
    ] = 0.01,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for a report and its figures.")
    ] = None,
    json: Json = False,
) -> None:
    """Relative errors by KITTI's segment rules, ATE and RPE; plots with --out.

    Poses belong together by their times where both files tell them (TUM, --times), else in order.

    Examples:
      recon evaluate trajectory outputs/map/latest/trajectory_kitti.txt poses.txt --out outputs/path
      recon evaluate trajectory trajectory_tum.txt groundtruth.txt --align sim3
    """
    with session():
        from recon.evaluation import TrajectoryRules
        from recon.pipeline.evaluate_trajectory import TrajectoryFiles, run_evaluate_trajectory
        from recon.reports.trajectory_report import present_trajectory

        asked = {
            "alignment": align.value,
            "lengths_m": parse_numbers(lengths, "--lengths"),
            "step_frames": step,
            "rpe_frames": rpe_frames,
        }
        rules = TrajectoryRules.parse(asked, where="recon evaluate trajectory")
        files = TrajectoryFiles(estimate, truth, times, tolerance)
        figures = run_evaluate_trajectory(files, rules, out, present_trajectory)
    print_json(figures) if json else print_evaluation(f"{estimate} against {truth}", figures)
