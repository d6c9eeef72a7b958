"""Cameras and what they record: `recon board`, `calibrate`, `rectify`, `audit` and `capture`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli import options as opt
from recon.cli.drive_options import SourceOptions, Start
from recon.cli.errors import one_line_errors, until_interrupted
from recon.cli.tables import print_summary
from recon.core.errors import SettingsError
from recon.core.text import is_count

_BOARD = (
    "chess:9x6:25mm (inner corners, square size), charuco:8x6:30mm:22mm:5x5_100 (squares, square "
    "size, marker size, dictionary), aprilgrid:6x6:88mm:0.3 (tags, tag size, gap relative to it), "
    "circles:7x6:20mm:10mm or acircles:4x11:20mm:16mm (circles, step, diameter), or a "
    "target.yaml of kalibr."
)


@opt.takes_groups
def calibrate(
    left: Annotated[
        str,
        typer.Argument(
            help='Left images: a folder, a pattern in quotes such as "left*.png", or a video; or '
            "one video with both views."
        ),
    ],
    board: Annotated[str, opt.option(_BOARD)],
    right: Annotated[
        str | None,
        typer.Argument(help="Right images, likewise.", show_default="both views are in LEFT"),
    ] = None,
    out: Annotated[Path | None, opt.option("Calibration file to write.", "--out", "-o")] = None,
    form: Annotated[
        Literal["recon", "opencv", "ros", "kalibr"] | None,
        opt.option(
            "Format of that file; ros writes two, _left and _right.",
            "--format",
            "-f",
            default="by its name, as recon audit --repair",
        ),
    ] = None,
    model: Annotated[
        Literal["radtan", "rational", "fisheye"] | None,
        opt.setting(
            "calibration.model",
            "radtan (usual), rational (wide angle), fisheye (150 degrees or more).",
        ),
    ] = None,
    distance: Annotated[
        float | None,
        opt.setting("calibration.working_m", "Distance in metres for which the verdict is made."),
    ] = None,
    report: Annotated[
        Path | None,
        opt.option("Folder for report and figures.", default="outputs/calibrate/<UTC time stamp>"),
    ] = None,
    *,
    shared: opt.Shared,
) -> None:
    """Calibrate a stereo rig from images of a board, predict its depth error, and judge it.

    The verdict is good, usable or repeat, with what to do about it. Views that
    do not fit are dropped and named, repeated ones count once; intervals come
    from a bootstrap over the views. Good images: docs/calibration.md.

    Examples:
      recon calibrate "left*.png" "right*.png" --board chess:9x6:25mm -o rig.yaml
      recon calibrate left/ right/ --board charuco:8x6:30mm:22mm:5x5_100
      recon calibrate both.mp4 --board chess:9x6:25mm
      recon calibrate left/ right/ --board april_6x6.yaml --model fisheye
    """
    with shared.one_line_errors():
        from recon.commands.cameras import run_calibrate
        from recon.commands.config import load_config
        from recon.io.atomic import check_targets
        from recon.io.cameras.targets import read_board
        from recon.rig.written import form_of, targets_of

        if out is not None:
            form = form or form_of(out)
            check_targets(targets_of(out, form), filter(None, [shared.config]))
        # kalibr's lens model has two radial terms.
        fitting = ["calibration.radial_terms=2"] if form == "kalibr" else []
        settings = load_config(shared.config, [*fitting, *shared.changes])
        run = run_calibrate(
            left,
            right,
            read_board(board),
            settings,
            file=out,
            form=form,
            out=report,
            threads=shared.threads,
        )
    shared.show(run.summary)


def board(
    pattern: Annotated[str | None, typer.Argument(metavar="BOARD", help=_BOARD)] = None,
    same: Annotated[
        str | None, opt.option("The board as an option, as in recon calibrate.", "--board")
    ] = None,
    out: Annotated[Path, opt.option("PDF or PNG file to write.", "--out", "-o")] = Path(
        "board.pdf"
    ),
    paper: Annotated[
        str | None,
        opt.option(
            "a4 to a0, letter, legal, tabloid, or e.g. 600x400mm.",
            default="smallest A size that fits",
        ),
    ] = None,
    dpi: Annotated[
        float, opt.option("Approximate resolution of a PNG, in pixels per inch.", min=30, max=2400)
    ] = 300.0,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Draw a calibration board to scale, for printing.

    Print it at 100 % and check the ruler on it before use.

    Examples:
      recon board chess:9x6:25mm --out board.pdf --paper a4
      recon board charuco:8x6:30mm:22mm:5x5_100 --out charuco.png
      recon board aprilgrid:6x6:30mm:0.3 --out april.pdf
    """
    wanted = pattern or same
    if wanted is None or (pattern and same):
        raise typer.BadParameter("name one board, such as chess:9x6:25mm")
    with one_line_errors(quiet=quiet):
        from recon.io.cameras.targets import read_board
        from recon.rig.board_sheet import write_board

        drawn = write_board(out, read_board(wanted), paper, dpi)
    print_summary(drawn, as_json=json)


@opt.takes_groups
def rectify(
    left: Annotated[
        str, typer.Argument(help='Left image, folder, or pattern in quotes such as "left*.png".')
    ],
    right: Annotated[str, typer.Argument(help="Right image, folder or pattern.")],
    calib: Annotated[
        Path | None,
        opt.option(
            "Calibration of the raw cameras. Without one, homographies are estimated from "
            "image features, and depth has no scale."
        ),
    ] = None,
    unit_m: Annotated[
        float | None,
        opt.option("Metres per unit in an OpenCV file, e.g. 0.001 for mm. [1]", min=1e-6),
    ] = None,
    out: opt.Out = None,
    *,
    shared: opt.Shared,
) -> None:
    """Rectify a pair or two folders of images, with or without a calibration.

    Writes the rectified images, the remaining epipolar error, and pictures with
    epipolar lines.

    Examples:
      recon rectify left/ right/ --calib rig.yaml --out rectified
      recon rectify left.png right.png
    """
    with shared.one_line_errors():
        from recon.commands.cameras import run_rectify

        settings = shared.settings()
        unit_m = unit_m or settings.source.metres_per_unit
        run = run_rectify(
            left,
            right,
            settings,
            calibration=calib,
            metres_per_unit=unit_m,
            out=out,
            threads=shared.threads,
        )
    shared.show(run.summary)


@opt.takes_groups
def audit(
    source: Annotated[Path, typer.Argument(help=opt.SOURCES_HELP)],
    repair: Annotated[
        Path | None,
        opt.option(
            "Write the rig that features and motion show to a file: NAME.yaml is ours, NAME.yml, "
            ".xml or .json OpenCV's, camchain.yaml kalibr's, camera_info.yaml ROS's two files.",
            "--repair",
        ),
    ] = None,
    out: Annotated[
        Path | None, opt.option("Folder for a report with images.", "--out", "-o", default="none")
    ] = None,
    start: Start = None,
    verbose: opt.Verbose = False,
    *,
    reading: SourceOptions,
    shared: opt.Asked,
) -> None:
    """Check a recording before a long run: good, usable or not usable, and why.

    Looks at row alignment, swapped, delayed or frozen cameras, missing and
    repeated frames, exposure, focus and baseline, and predicts the depth error.
    The motion of the drive shows how the rig differs from its calibration, but
    not the scale; recon map uses that rig by itself.
    With --out, a report has sample pairs, epipolar errors and disparities.

    Examples:
      recon audit drive.bag --calib camchain.yaml
      recon audit rides/today --repair repaired.yaml
      recon audit rides/today --repair camchain.yaml
      recon audit rides/today --out audited
    """
    with shared.one_line_errors():
        from recon.cli.progress import announce
        from recon.commands.cameras import run_audit
        from recon.io.atomic import check_targets
        from recon.rig.written import targets_of
        from recon.sources.registry import open_source

        if repair is not None:
            check_targets(targets_of(repair), filter(None, [shared.config]))
        settings = shared.settings()
        drive = open_source(source, reading.kind, settings.source)
        announce(drive, quiet=shared.quiet, verbose=verbose)
        found = run_audit(drive, settings, repair=repair, out=out)
    summary = found.summary
    summary = replace(summary, path=str(source))
    if out is not None and not shared.json:
        summary = replace(summary, out=str(out))
    print_summary(summary, as_json=shared.json, verbose=verbose)


def _size(text: str) -> dict[str, list[str]]:
    width, _, height = text.partition("x")
    if not (is_count(width) and is_count(height)):
        raise SettingsError("cannot read this size", got=text, expected="WIDTHxHEIGHT: 1280x720")
    return {"capture.size_px": [width, height]}


@opt.takes_groups
def capture(
    left: Annotated[
        str,
        typer.Argument(help="Left camera (0, /dev/video0) or video, or one that has both views."),
    ],
    out: Annotated[Path, opt.option("New folder for the recording.", "--out", "-o")],
    right: Annotated[str | None, typer.Argument(help="Right camera or video.")] = None,
    calib: Annotated[
        Path | None, opt.option("Calibration file to copy into the folder.", "--calib")
    ] = None,
    frames: Annotated[int | None, opt.option("Stop after this many pairs.", min=1)] = None,
    seconds: Annotated[float | None, opt.option("Stop after this many seconds.")] = None,
    size: Annotated[str | None, opt.setting(_size, "Requested image size, e.g. 1280x720.")] = None,
    rate: Annotated[
        float | None, opt.setting("capture.rate_hz", "Requested frame rate, in frames per second.")
    ] = None,
    board: Annotated[
        str | None, opt.option("Say which views of this board are missing, see recon board.")
    ] = None,
    preview: Annotated[int | None, opt.option("Update preview.jpg every N pairs.", min=1)] = None,
    *,
    shared: opt.Asked,
) -> None:
    """Record a drive from two cameras, or from one that has both views side by side.

    Stop with Ctrl-C. The folder is valid at any moment, and recon map takes it
    as it is.

    Examples:
      recon capture 0 2 --out rides/today --calib stereo.yaml --size 1280x720
      recon capture 0 2 --out views --board chess:9x6:25mm
      recon capture /dev/video4 --out rides/today --set capture.suffix=jpg
    """
    with shared.one_line_errors():
        from recon.commands.cameras import run_capture
        from recon.io.cameras.targets import read_board
        from recon.rig.capture import RecordingSettings

        known = shared.settings()
        limits = {"frames": frames, "seconds": seconds, "preview_every": preview}
        views = {"side_by_side": known.source.side_by_side}
        settings = RecordingSettings.parse({**dict(known.capture), **views, **limits})
        devices = [left] if right is None else [left, right]
        with until_interrupted() as stopped:
            shown = None if board is None else read_board(board)
            summary = run_capture(
                devices, out, settings, calibration=calib, board=shown, stopped=stopped
            )
    print_summary(summary, as_json=shared.json)
