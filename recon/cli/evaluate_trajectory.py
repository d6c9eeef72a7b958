"""`recon evaluate trajectory`: compare a trajectory with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli.options import Json, Quiet, parse_numbers
from recon.cli.session import session
from recon.cli.show.tables import print_evaluation, print_json


def trajectory(
    estimate: Annotated[Path, typer.Argument(help="Estimated trajectory, in KITTI or TUM format.")],
    truth: Annotated[Path, typer.Argument(help="Ground truth, in either format.")],
    align: Annotated[
        Literal["none", "origin", "se3", "sim3"],
        typer.Option(
            help="Alignment of the estimate: none, at the first pose (origin), rigid (se3), or "
            "rigid with scale (sim3)."
        ),
    ] = "se3",
    lengths: Annotated[
        str | None,
        typer.Option(
            help="Lengths of the segments in metres, e.g. 50,100.",
            show_default="100 to 800, or shorter on short drives",
        ),
    ] = None,
    step: Annotated[
        int | None,
        typer.Option(
            help="Frames between the starts of segments.",
            show_default="10, or 1 on short drives",
        ),
    ] = None,
    rpe_frames: Annotated[int, typer.Option(help="Frame distance of the RPE.")] = 1,
    times: Annotated[
        Path | None,
        typer.Option(help="Times of the poses of a KITTI file, in seconds, one per line."),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(min=0, help="Largest time difference between two matched poses, in seconds."),
    ] = 0.01,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for a report and its plots.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare a trajectory with ground truth: KITTI's relative errors, ATE and RPE.

    Poses are matched by time where both files have times (TUM, or KITTI with
    --times), else in order. With --out, writes a report with plots.

    Examples:
      recon evaluate trajectory trajectory_kitti.txt poses.txt --out outputs/path
      recon evaluate trajectory trajectory_tum.txt groundtruth.txt --align sim3
    """
    with session(quiet=quiet):
        from recon.commands.evaluate_trajectory import run_evaluate_trajectory
        from recon.evaluation.trajectory import TrajectoryRules

        asked = {
            "alignment": align,
            "lengths_m": parse_numbers(lengths, "--lengths"),
            "step_frames": step,
            "rpe_frames": rpe_frames,
        }
        rules = TrajectoryRules.parse(asked, where="recon evaluate trajectory")
        figures = run_evaluate_trajectory(
            estimate, truth, rules, times=times, tolerance_s=tolerance, out=out
        )
    print_json(figures) if json else print_evaluation(f"{estimate} against {truth}", figures)
