"""`recon map` and `recon merge`: map a stereo drive; make one map of several."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli import options as opt
from recon.cli.drive_options import DriveOptions, Start, open_drive, open_workers
from recon.cli.errors import one_line_errors
from recon.cli.tables import print_json, print_run


@opt.takes_groups
def map_(
    source: Annotated[Path | None, typer.Argument(help=opt.SOURCES_HELP)] = None,
    out: opt.Out = None,
    start: Start = None,
    odometry: Annotated[
        Literal["visual", "kiss", "fused"] | None,
        opt.setting(
            "odometry.method",
            help="visual: features followed from frame to frame; kiss: kiss-icp on the points that "
            "stereo measures well, to compare with; fused: earlier name of visual.",
            show_default="visual",
        ),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Known poses (KITTI or TUM), used instead of odometry.")
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|TOPIC",
            help="Trajectory from wheel odometry, an IMU or GNSS that guides the odometry: a TUM "
            "file on the clock of the images, or a topic of the bag, such as /odom.",
        ),
    ] = None,
    mesh: opt.Mesh = True,
    resume: Annotated[
        Path | None,
        typer.Option(help="Continue the interrupted run in this folder; without SOURCE."),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(
            help="Add the drive to the map of this finished run, which is replaced when all is "
            "done; settings are those of the run."
        ),
    ] = None,
    remove: Annotated[
        int | None,
        typer.Option(
            metavar="SESSION", help="With --into, without SOURCE: take a drive out of its map."
        ),
    ] = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
    *,
    reading: DriveOptions,
    shared: opt.Shared,
) -> None:
    """Map a stereo drive: trajectory, point cloud, Nav2 grid, OctoMap, mesh, report.

    The kind of source is detected from its files. Loops are closed, and frames
    whose pose cannot be trusted are named and left out of the map.

    Examples:
      recon map ~/kitti/sequences/06 --out outputs/kitti06
      recon map drive.bag --calib camchain.yaml --left /cam0 --right /cam1
      recon map left.mp4 --right right.mp4 --calib stereo.yaml
      recon map rides/today --prior wheels.txt
      recon map drive.bag --prior /odom
      recon map --resume outputs/kitti06
      recon map rides/long --workers 4
      recon map rides/tomorrow --into outputs/map/latest
      recon map --into outputs/map/latest --remove 1
    """
    if poses is not None and prior is not None:
        raise typer.BadParameter("--poses leaves nothing for --prior to do; give one of them")
    _check_folders(source, out, resume, into, remove)
    if into is not None and (workers or scheduler) is not None:
        raise typer.BadParameter("--into maps the drive in one piece: no --workers, no --scheduler")
    with shared.one_line_errors():
        from recon.cli.progress import warn
        from recon.commands.config import run_settings
        from recon.commands.map import run_map
        from recon.commands.merge import run_map_into, run_remove

        options = shared.options(
            out=out,
            mesh=mesh,
            warn=partial(warn, quiet=shared.quiet, verbose=shared.verbose),
            workers=open_workers(workers, scheduler, shared),
            source=source,
            kind=reading.kind,
            poses_file=poses,
            prior_from=prior,
        )
        if resume is not None:
            options, settings = options.resumed(resume, shared.config, shared.changes)
        elif into is not None:
            of_the_source = () if remove is not None else ("source",)
            settings = run_settings(into, shared.config, shared.changes, of_the_source)
        else:
            settings = shared.settings()
        if into is not None and remove is not None:
            summary = run_remove(into, remove, settings, options)
        else:
            drive, options = open_drive(options, settings, shared)
            if into is not None:
                summary = run_map_into(into, drive, settings, options)
            else:
                summary = run_map(drive, settings, options).summary
    shared.show(summary)


def _check_folders(
    source: Path | None,
    out: Path | None,
    resume: Path | None,
    into: Path | None,
    remove: int | None,
) -> None:
    """Refuse options that say nothing together."""
    if out is not None and resume is not None and os.path.realpath(out) != os.path.realpath(resume):
        raise typer.BadParameter("--out and --resume name different folders")
    if into is not None and (resume is not None or out is not None):
        raise typer.BadParameter("--into changes RUN, whole or not at all: no --out, no --resume")
    if remove is not None and (into is None or source is not None):
        raise typer.BadParameter("--remove takes a session out of --into RUN, and maps no SOURCE")
    if source is None and resume is None and remove is None:
        raise typer.BadParameter("give SOURCE, or --resume FOLDER")


def piece(
    plan: Annotated[Path, typer.Argument(help="Plan of the pieces, in the folder of the run.")],
    number: Annotated[int, typer.Argument(help="Number of the piece.")],
    out: Annotated[Path | None, typer.Option(help="New folder of the piece.")] = None,
    resume: Annotated[Path | None, typer.Option(help="Folder of one to go on with.")] = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
    threads: opt.Threads = None,
) -> None:
    """Map one piece of a drive, or go on with it.

    The workers of recon map --workers run this. Its result is the map of the
    piece, which that command joins with the others.

    Examples:
      recon piece outputs/long/.partial/.state/pieces.json 0 --out piece0
    """
    folder = resume or out
    if folder is None:
        raise typer.BadParameter("give --out FOLDER or --resume FOLDER")
    with one_line_errors(quiet=quiet):
        from recon.cli.progress import choose_viewer
        from recon.commands.map_pieces import run_piece

        viewer = choose_viewer(quiet=quiet, verbose=verbose)
        going_on = resume is not None
        summary = run_piece(plan, number, folder, resume=going_on, threads=threads, progress=viewer)
    print_json(summary) if json else print_run(summary, stages=verbose)


@opt.takes_groups
def merge(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN RUN...",
            help="Folders of finished runs, the oldest first; with --georeference, one will do.",
        ),
    ],
    out: opt.Out = None,
    georeference: Annotated[
        Path | None,
        typer.Option(
            help="Measured positions, which the paths are bent to run through: rows of time, "
            "easting, northing and height (s, m), on the clock of the images.",
            show_default="none",
        ),
    ] = None,
    antenna: opt.Antenna = None,
    mesh: opt.Mesh = True,
    *,
    shared: opt.Shared,
) -> None:
    """Make one map of several runs: linked by places that two saw, or by measured positions.

    Cloud, grid, OctoMap and mesh are made of all drives that are linked with
    the first. What a later run saw free loses what an earlier one saw there.
    Drives that share no place are kept apart, and named. Positions that were
    measured along drives, by GNSS or a total station, take the drift out of their
    paths, and place drives that share no place.

    Examples:
      recon merge outputs/monday outputs/friday --out outputs/week
      recon merge outputs/week outputs/sunday --no-mesh
      recon merge outputs/site --georeference gnss.txt --antenna=-0.4,0.1,0.7
    """
    with shared.one_line_errors():
        from recon.commands.config import run_settings
        from recon.commands.merge import run_merge

        settings = run_settings(runs[0], shared.config, shared.changes)
        options = shared.options("merge", out, mesh=mesh)
        summary = run_merge(runs, settings, options, opt.survey_of(georeference, antenna))
    shared.show(summary)
