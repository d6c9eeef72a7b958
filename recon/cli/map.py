"""Drives and their maps: `recon map`, `merge`, `live` and `localize`."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from recon.cli import options as opt
from recon.cli.drive_options import (
    DriveOptions,
    Start,
    StartInMap,
    open_drive,
    open_workers,
    read_start,
)
from recon.cli.errors import one_line_errors, until_interrupted
from recon.cli.tables import print_summary
from recon.cli.view import View

if TYPE_CHECKING:
    from recon.core.summary import RunSummary
    from recon.sources.source import StereoSource


def _length(text: str) -> dict[str, Any]:
    numbers = opt.parse_numbers(text, "--length") or ()
    return {"source.length": list(numbers)}


def _check_into(
    into: Path | None, source: Path | None, remove: int | None, keep: list[str] | None, *more: Any
) -> None:
    """Refuse options that do not go with --into RUN (also ``more``, if given), or nowhere else."""
    if into is None and keep:
        raise typer.BadParameter("--keep says what the map of --into RUN keeps")
    if remove is not None and (into is None or source is not None):
        raise typer.BadParameter("--remove takes a session out of --into RUN, and maps no SOURCE")
    if into is not None and any(one is not None for one in more):
        what = "changes RUN in one step: no --out, --resume, --workers, --scheduler, --view"
        raise typer.BadParameter(f"--into {what}")
    if into is not None and source is None and remove is None and not keep:
        raise typer.BadParameter("--into RUN takes SOURCE, --remove SESSION or --keep")


@opt.takes_groups
def map_(
    source: Annotated[Path | None, typer.Argument(help=opt.SOURCES_HELP)] = None,
    out: opt.Out = None,
    start: Start = None,
    odometry: Annotated[
        str | None,
        opt.setting(
            "odometry.method",
            "visual (also named fused): features; kiss: kiss-icp on points, to compare with; sfm: "
            "structure from motion, for pairs in any order (extra sfm); or a plug-in.",
            default="visual",
        ),
    ] = None,
    poses: Annotated[
        Path | None, opt.option("Known poses (KITTI or TUM), used instead of odometry.")
    ] = None,
    prior: Annotated[
        str | None,
        opt.option(
            "Trajectory of wheels, an IMU or GNSS that guides the odometry: a TUM file on the "
            "clock of the images, or a topic of the bag, such as /odom.",
            metavar="FILE|TOPIC",
        ),
    ] = None,
    length: Annotated[
        str | None,
        opt.setting(
            _length,
            "Two frames, counted from 0, and metres between the left camera in them, by a tape or "
            "GNSS: they show the baseline, which scales the map.",
            metavar="A,B,METRES",
        ),
    ] = None,
    mesh: opt.Mesh = True,
    resume: Annotated[
        Path | None, opt.option("Continue the interrupted run in this folder; without SOURCE.")
    ] = None,
    into: Annotated[
        Path | None,
        opt.option("Add the drive to the map of this finished run, with the settings of the run."),
    ] = None,
    remove: Annotated[
        int | None,
        opt.option("With --into, without SOURCE: take a drive out of its map.", metavar="SESSION"),
    ] = None,
    keep: Annotated[
        list[str] | None,
        opt.option(
            "With --into: what the map keeps. N: of each place the newest N drives, and what only "
            "older ones saw; 90d: drives up to 90 days older than the newest; X0,Y0,X1,Y1: what "
            "lies there, in map metres; all. May be repeated.",
            metavar="N|DAYS|REGION|all",
            default="2 with SOURCE, else all",
        ),
    ] = None,
    changes: opt.Compared = False,
    date: Annotated[
        str | None,
        opt.option(
            "Day of the drive, UTC, such as 2026-11-30 or 2026-11-30T14:05.",
            default="by stamps or files",
        ),
    ] = None,
    check: Annotated[
        Path | None,
        opt.option("Read every record of a map (RUN or its file), and say what is in it."),
    ] = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
    view: View = False,
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
      recon map photos --odometry sfm
      recon map rides/today --prior wheels.txt
      recon map drive.bag --prior /odom
      recon map rides/today --length 0,143,118.3
      recon map --resume outputs/kitti06
      recon map rides/long --workers 4
      recon map rides/tomorrow --into outputs/map/latest
      recon map --into outputs/map/latest --remove 1
      recon map --into outputs/map/latest --keep 2 --keep 90d
      recon map --check outputs/map/latest
    """
    if check is not None:
        others = (source, out, resume, into, remove, keep, date, *shared.changes)
        _check(check, others, shared)
        return
    if poses is not None and prior is not None:
        raise typer.BadParameter("--poses leaves nothing for --prior to do; give one of them")
    if out is not None and resume is not None and os.path.realpath(out) != os.path.realpath(resume):
        raise typer.BadParameter("--out and --resume name different folders")
    if changes and into is None:
        raise typer.BadParameter("--changes compares a drive with those of --into RUN")
    _check_into(into, source, remove, keep, out, resume, workers, scheduler, view or None)
    if source is None and (date is not None or (resume is None and into is None)):
        raise typer.BadParameter("give SOURCE, or --resume FOLDER, which has its --date")
    if view and (workers or scheduler) is not None:
        raise typer.BadParameter("--view follows one map that grows: no --into, --workers")
    with shared.one_line_errors():
        from recon.cli.progress import warn
        from recon.commands.config import run_settings
        from recon.commands.map import run_map
        from recon.commands.merge import run_map_into, run_remove
        from recon.core.dates import given_date
        from recon.map.sessions.keep import Keep

        options = shared.options(
            out=out,
            view=view,
            mesh=mesh,
            warn=partial(warn, quiet=shared.quiet, verbose=shared.verbose),
            workers=open_workers(workers, scheduler, shared),
            source=source,
            kind=reading.kind,
            poses_file=poses,
            prior_from=prior,
            keep=Keep.parse(keep, "--keep") if keep else None,
            changes=changes,
            date=None if date is None else given_date(date, "--date"),
        )
        if resume is not None:
            options, settings = options.resumed(
                resume, shared.config, shared.changes, preset=shared.preset
            )
        elif into is not None:
            of_the_source = () if source is None else ("source",)
            settings = run_settings(
                into, shared.config, shared.changes, of_the_source, preset=shared.preset
            )
        else:
            settings = shared.settings()
        if into is not None and source is None:
            shown: RunSummary = run_remove(into, remove, settings, options)
        else:
            drive, options = open_drive(options, settings, shared)
            shown = (
                run_map(drive, settings, options).summary
                if into is None
                else run_map_into(into, drive, settings, options)
            )
    shared.show(shown)


def _check(path: Path, others: tuple[Any, ...], shared: opt.Shared) -> None:
    if any(other is not None for other in others):
        raise typer.BadParameter("--check reads a map, and maps nothing: give it alone")
    with shared.one_line_errors():
        from recon.commands.check import check_map

        content = check_map(path)
        shared.show(content)
        content.refuse_damage()


def piece(
    plan: Annotated[Path, typer.Argument(help="Plan of the pieces, in the folder of the run.")],
    number: Annotated[int, typer.Argument(help="Number of the piece.")],
    out: Annotated[Path | None, opt.option("New folder of the piece.")] = None,
    resume: Annotated[Path | None, opt.option("Folder of one to go on with.")] = None,
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
    if out is None and resume is None:
        raise typer.BadParameter("give --out FOLDER or --resume FOLDER")
    with one_line_errors(quiet=quiet, verbose=verbose):
        from recon.commands.map_options import MapOptions
        from recon.commands.map_pieces import run_piece

        options = MapOptions("piece", resume or out, threads, resume=resume is not None)
        summary = run_piece(plan, number, options)
    print_summary(summary, as_json=json, verbose=verbose)


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
        opt.option(
            "Measured positions, which the paths are optimised to run through." + opt.POSITIONS
        ),
    ] = None,
    antenna: opt.Antenna = None,
    mesh: opt.Mesh = True,
    changes: opt.Compared = False,
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

        settings = run_settings(runs[0], shared.config, shared.changes, preset=shared.preset)
        options = shared.options("merge", out, mesh=mesh, changes=changes)
        summary = run_merge(runs, settings, options, opt.survey_of(georeference, antenna))
    shared.show(summary)


@opt.takes_groups
def diff(
    before: Annotated[Path, typer.Argument(help="Folder of a finished run, or its map file.")],
    after: Annotated[Path, typer.Argument(help="That of a later run through the same place.")],
    out: opt.Out = None,
    *,
    shared: opt.Shared,
) -> None:
    """Find what came and what went between two runs through one place.

    Each may hold several drives. They are linked by places that both saw. Points
    of either day are the same, came, went, or could not be compared, since the
    other day did not look there. Objects are listed with place, size, volume,
    when they were seen, and a picture of both days. The settings are those of the
    first run.

    Examples:
      recon diff outputs/monday outputs/friday --out outputs/changes
    """
    if shared.config is not None or shared.preset is not None or shared.changes:
        raise typer.BadParameter("runs are compared as the first was mapped: no --config, --set")
    with shared.one_line_errors():
        from recon.commands.diff import run_diff

        summary = run_diff(before, after, shared.options("diff", out))
    shared.show(summary)


@opt.takes_groups
def live(
    source: Annotated[
        str,
        typer.Argument(
            help="Left camera (0, /dev/video0, address of a stream) or one that has both views; "
            "topics of ROS 2 (ros2:/left/image_raw,/right/image_raw); or a recording. "
            + opt.SOURCES_HELP
        ),
    ],
    right_camera: Annotated[
        str | None, typer.Argument(help="Right camera, or the right video as if it were one.")
    ] = None,
    rate: Annotated[
        float, opt.option("How many times as fast as recorded a recording is played.")
    ] = 1.0,
    map_: Annotated[
        Path | None,
        opt.option(
            "Find the drive in this map, a run folder or a map file, and make none.",
            "--map",
            default="make a map",
        ),
    ] = None,
    prior: Annotated[
        str | None,
        opt.option("Topic of the odometry of wheels, with ros2:.", metavar="TOPIC"),
    ] = None,
    out: opt.Out = None,
    start: StartInMap = None,
    to: opt.To = None,
    mesh: opt.Mesh = False,
    view: View = False,
    *,
    reading: DriveOptions,
    shared: opt.Shared,
) -> None:
    """Map a drive while its images arrive, from cameras or from a recording.

    A recording is played at its time stamps. The pose of each frame comes first;
    matching follows as far as there is time. Where even poses take too long,
    frames are dropped. summary.json counts both, and the time from an image to
    its pose. Ctrl-C ends the drive, and its map is completed. The rig is as it is
    calibrated; what the drive shows of it is in rig.yaml, for the next one. With
    --map, it is as the last drive of the map with this calibration showed it.

    From topics of ROS 2 (ros2:), an inertial unit and /tf_static are used, too,
    and /tf, /odometry, /pose, /path, /map, /costmap, /cloud and /diagnostics are
    published. ROS_DOMAIN_ID names the domain; only this machine is talked to,
    unless ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET or CYCLONEDDS_URI ask for more.

    Examples:
      recon live 0 2 --calib stereo.yaml
      recon live rides/today --rate 2
      recon live rides/today --map outputs/map/latest
      recon live ros2:/left/image_raw,/right/image_raw --map outputs/map/latest
    """
    with shared.one_line_errors(), ExitStack() as stack:
        from recon.cli.progress import announce
        from recon.commands.localize import run_live
        from recon.map.map import Map
        from recon.rig.capture import is_camera, open_camera_source
        from recon.sources.ros2 import ADDRESS, open_ros2

        stopped = stack.enter_context(until_interrupted())
        pose, _ = read_start(start)
        settings = shared.settings()
        asked = {"source": source, "kind": reading.kind, "bag": opt.is_bag(to)}
        options = shared.options("live", out, view=view, mesh=mesh, **asked)
        drive: StereoSource
        if prior is not None and not source.startswith(ADDRESS):
            raise typer.BadParameter(f"--prior is a topic of {ADDRESS}; recon map takes files")
        if source.startswith(ADDRESS):
            if right_camera is not None:
                raise typer.BadParameter(f"both topics are one argument: {ADDRESS}/left,/right")
            if rate != 1.0:
                raise typer.BadParameter("--rate plays a recording; topics come at their own rate")
            if map_ is not None:  # one that is none is said before cameras are waited for
                stack.enter_context(Map.open(map_))
            topics = stack.enter_context(open_ros2(source, settings.source, prior, stopped))
            options = replace(options, writers=[topics.network], stamp_ns=topics.stamp_ns)
            drive = topics
            announce(drive, quiet=shared.quiet, verbose=shared.verbose)
        elif right_camera is not None or is_camera(source):
            devices = [source] if right_camera is None else [source, right_camera]
            cameras = open_camera_source(devices, settings.capture, settings.source, stopped)
            drive = stack.enter_context(cameras)
            announce(drive, quiet=shared.quiet, verbose=shared.verbose)
        else:
            drive, options = open_drive(options, settings, shared)
        summary = run_live(
            drive, settings, options, rate=rate, map_path=map_, start=pose, stopped=stopped
        )
    shared.show(summary)


@opt.takes_groups
def localize(
    source: Annotated[Path, typer.Argument(help=opt.SOURCES_HELP)],
    map_: Annotated[
        Path, opt.option("The map: folder of a recon map or recon demo run, or its file.", "--map")
    ],
    out: opt.Out = None,
    start: StartInMap = None,
    to: opt.To = None,
    view: View = False,
    *,
    reading: DriveOptions,
    shared: opt.Shared,
) -> None:
    """Find a drive in a map that is there already: the pose of each frame.

    The first frames are recognised by the keyframes of the map, later ones
    tracked against its features and surfaces. Frames are searching (no pose),
    tracking (the map confirms the pose), coasting (the pose is by odometry alone,
    for some metres at most) or lost (no pose any more). The map is not changed.
    The rig begins as the last drive of the map with its calibration showed it.

    Examples:
      recon localize rides/today --map outputs/map/latest
      recon localize rides/today --map outputs/map/latest --start 12.5,-3,90
    """
    with shared.one_line_errors():
        from recon.commands.localize import run_localize

        pose, _ = read_start(start)
        settings = shared.settings()
        asked = {"source": source, "kind": reading.kind, "bag": opt.is_bag(to)}
        options = shared.options("localize", out, view=view, **asked)
        drive, options = open_drive(options, settings, shared)
        run = run_localize(drive, map_, settings, options, start=pose)
    shared.show(run.summary)
