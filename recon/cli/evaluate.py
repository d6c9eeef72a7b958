"""`recon evaluate` and `recon paper`: compare results with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.options import Commands
from recon.cli.tables import (
    print_json,
    print_remarks,
    print_rows,
    print_summary,
)

app = Commands(name="evaluate", no_args_is_help=True, help="Compare results with ground truth.")

Matchers = Annotated[
    str | None,
    opt.option(
        "Matchers, with commas, as for recon pair; none for --results alone.",
        "--matcher",
        default="sad",
    ),
]


@app.command()
@opt.takes_groups
def middlebury(
    folder: Annotated[
        Path, typer.Argument(help="A Middlebury scene, or a folder with scenes at any depth.")
    ],
    matcher: Matchers = None,
    results: Annotated[
        list[Path] | None,
        opt.option("Results of another program: SCENE.pfm or SCENE/disp0*.pfm. May be repeated."),
    ] = None,
    truth: Annotated[
        Path | None,
        opt.option("Folder with the same scenes at another size, for those without ground truth."),
    ] = None,
    parallel: Annotated[
        int, opt.option("Scenes to process at once. Above 1, the times mean nothing.", min=1)
    ] = 1,
    range_: Annotated[
        Literal["scene", "auto"],
        opt.option(
            "Disparity range: published with the scene (before 2014: from its ground "
            "truth), or estimated from each pair.",
            "--range",
        ),
    ] = "scene",
    out: opt.Out = None,
    latex: Annotated[
        bool, opt.option("Print the tables in LaTeX, the best value in bold.", "--latex")
    ] = False,
    *,
    shared: opt.Shared,
) -> None:
    """Score matchers on Middlebury scenes with the measures of the benchmark.

    Several matchers, separated by commas, are compared in one run, and with
    --results those of other programs beside them. Measured and inferred
    pixels are scored together, and each kind alone.

    Examples:
      recon evaluate middlebury MiddEval3/trainingQ --matcher sad,sgm,opencv-sgbm
      recon evaluate middlebury MiddEval3/trainingH --truth MiddEval3/trainingQ
      recon evaluate middlebury MiddEval3/trainingQ --results results/mine --latex
    """
    if shared.json and latex:
        raise typer.BadParameter("--json and --latex exclude each other")
    with shared.one_line_errors():
        from recon.commands.config import PAIR_DEFAULTS
        from recon.commands.evaluate_middlebury import run_middlebury
        from recon.report.middlebury_page import middlebury_tables
        from recon.report.sections import Table, join

        summary = run_middlebury(
            folder,
            shared.settings(PAIR_DEFAULTS),
            matchers=_names(matcher),
            results=results or (),
            truth=truth,
            out=out,
            threads=shared.threads,
            parallel=parallel,
            auto_range=range_ == "auto",
        )
        form = Table.latex if latex else Table.text
        tables = join(map(form, middlebury_tables(summary.to_json())))
    print_remarks(summary.remarks(), verbose=shared.verbose)
    if shared.json:
        print_json(summary.to_json())
        return
    if latex or shared.verbose:
        typer.echo(tables)
    if latex:
        typer.echo(f"results: {summary.out}", err=True)
    else:
        print_rows(summary.rows())


def _names(matcher: str | None) -> list[str] | None:
    names = None if matcher is None else opt.names_in([matcher])
    return [] if matcher == "none" else names


@app.command()
def disparity(
    estimate: Annotated[
        Path, typer.Argument(help="Disparity map: PFM, or 16-bit PNG as used by KITTI.")
    ],
    truth: Annotated[Path, typer.Argument(help="Ground truth, in either format.")],
    mask: Annotated[Path | None, opt.option("Image that is 255 at the pixels to compare.")] = None,
    scale: Annotated[
        float,
        opt.option("Scale of the errors: 4 reports a quarter-size map at full size.", min=1e-3),
    ] = 1.0,
    confidence: Annotated[
        Path | None, opt.option("Confidence of the map (PFM), to be evaluated too.")
    ] = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Compare a disparity map with ground truth: Middlebury's measures and KITTI's D1.

    Reported for the pixels that have a value (sparse) and with holes filled
    (dense).

    Examples:
      recon evaluate disparity disparity.pfm disp0GT.pfm
      recon evaluate disparity disparity.pfm disp0GT.pfm --mask mask0nocc.png
    """
    with one_line_errors(quiet=quiet, verbose=verbose):
        from recon.commands.evaluate import run_evaluate_disparity

        found = run_evaluate_disparity(estimate, truth, mask, scale=scale, confidence=confidence)
    print_summary(found, as_json=json, verbose=verbose)


@app.command()
def trajectory(
    estimate: Annotated[Path, typer.Argument(help="Estimated trajectory, in KITTI or TUM format.")],
    truth: Annotated[Path, typer.Argument(help="Ground truth, in either format.")],
    align: Annotated[
        Literal["none", "origin", "se3", "sim3", "upright"],
        opt.option(
            "Alignment of the estimate: none, at the first pose (origin), rigid (se3), or "
            "rigid with scale (sim3), or rigid where z is up in both (upright)."
        ),
    ] = "se3",
    lengths: Annotated[
        str | None,
        opt.option(
            "Lengths of the segments in metres.", default="100,200 … 800, shorter on short drives"
        ),
    ] = None,
    step: Annotated[
        int | None,
        opt.option("Frames between the starts of segments.", default="10, or 1 on short drives"),
    ] = None,
    rpe_frames: Annotated[int, opt.option("Frame distance of the RPE.")] = 1,
    times: Annotated[
        Path | None, opt.option("Times of the poses of a KITTI file, in seconds, one per line.")
    ] = None,
    tolerance: Annotated[
        float, opt.option("Largest time difference between two matched poses, in seconds.", min=0)
    ] = 0.01,
    out: Annotated[
        Path | None, opt.option("Folder for a report and its plots.", "--out", "-o")
    ] = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Compare a trajectory with ground truth: KITTI's relative errors, ATE and RPE.

    Poses are matched by time where both files have times (TUM, or KITTI with
    --times), else in order. With --out, writes a report with plots.

    Examples:
      recon evaluate trajectory trajectory_kitti.txt poses.txt --out outputs/path
      recon evaluate trajectory trajectory_tum.txt groundtruth.txt --align sim3
    """
    with one_line_errors(quiet=quiet, verbose=verbose):
        from recon.commands.evaluate import run_evaluate_trajectory
        from recon.evaluation.trajectory import TrajectoryRules

        asked = {
            "alignment": align,
            "lengths_m": opt.parse_numbers(lengths, "--lengths"),
            "step_frames": step,
            "rpe_frames": rpe_frames,
        }
        rules = TrajectoryRules.parse(asked, where="recon evaluate trajectory")
        found = run_evaluate_trajectory(
            estimate, truth, rules, times=times, tolerance_s=tolerance, out=out
        )
    print_summary(found, as_json=json, verbose=verbose)


@app.command()
def occupancy(
    run: Annotated[Path, typer.Argument(help="Folder of a recon demo run.")],
    least_frames: Annotated[
        int, opt.option("Compare only what at least this many frames saw.", min=1)
    ] = 3,
    picture: Annotated[
        Path | None, opt.option("PNG to draw: the grid with its errors in colour.")
    ] = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Compare voxels and grid of a demo run with the exact truth.

    Precision and recall of occupied voxels; intersection over union of the
    grid.

    Examples:
      recon evaluate occupancy outputs/demo/latest --picture compared.png
    """
    with one_line_errors(quiet=quiet, verbose=verbose):
        from recon.commands.evaluate import run_evaluate_occupancy

        compared = run_evaluate_occupancy(run, least_frames, image=picture)
    print_summary(compared.summary, as_json=json, verbose=verbose)


@app.command("map")
def map_(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or a PLY point cloud.")],
    reference: Annotated[Path, typer.Argument(help="Reference point cloud (PLY).")],
    reference_frame: Annotated[
        Literal["camera", "map"] | None,
        opt.option("Axes of REFERENCE.", default="camera, or where --align icp finds more"),
    ] = None,
    threshold: Annotated[
        str, opt.option("Distance in metres up to which a point is correct; several with commas.")
    ] = "0.2",
    align_to: Annotated[
        Path | None,
        opt.option("True poses (KITTI or TUM), to which path and map are aligned first."),
    ] = None,
    align: Annotated[
        Literal["none", "icp"], opt.option("Align the cloud to the reference with ICP.")
    ] = "none",
    out: Annotated[
        Path | None, opt.option("Folder for clouds coloured by error.", "--out", "-o")
    ] = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Compare a map with a reference cloud: precision, recall and F-score.

    Nothing is aligned unless asked for. With --out, writes both clouds coloured
    by error.

    Examples:
      recon evaluate map outputs/map/latest lidar_map.ply --threshold 0.1,0.2,0.5
      recon evaluate map outputs/map/latest lidar_map.ply --align-to poses.txt
    """
    with one_line_errors(quiet=quiet, verbose=verbose):
        from recon.commands.evaluate import run_evaluate_map

        found = run_evaluate_map(
            run,
            reference,
            frame=reference_frame,
            align_to=align_to,
            icp=align == "icp",
            thresholds_m=opt.parse_numbers(threshold, "--threshold") or (),
            out=out,
        )
    print_summary(found, as_json=json, verbose=verbose)


@opt.takes_groups
def paper(
    scenes: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with the Middlebury scenes ArtL, Jadeplant and Pipes at quarter size.",
            show_default="$RECON_DATA/middlebury/MiddEval3/trainingQ",
        ),
    ] = None,
    as_printed: Annotated[
        bool, opt.option("Also run the method as printed.", "--as-printed")
    ] = False,
    out: opt.Out = None,
    *,
    shared: opt.Shared,
) -> None:
    """Repeat experiments 2 to 4 of the paper that this project is based on.

    Writes disparity and depth maps, surfaces, clouds, depth curves, Table 1 and
    a report. What the paper misprints, and how it is corrected:
    docs/walk-research.md.

    Examples:
      recon paper MiddEval3/trainingQ
      recon paper MiddEval3/trainingQ --as-printed --out outputs/paper-as-printed
    """
    with shared.one_line_errors():
        from recon.commands.config import PAIR_DEFAULTS
        from recon.commands.paper import run_paper

        settings = shared.settings(PAIR_DEFAULTS)
        summary = run_paper(
            scenes, settings, out=out, threads=shared.threads, as_printed=as_printed
        )
    shared.show(summary)
