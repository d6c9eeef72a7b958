"""Options shared by commands, each defined once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.core.errors import SettingsError

Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder for the results.",
        show_default="outputs/<command>/<UTC time stamp>",
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="YAML file with settings, such as the config.yaml of a run."
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set", "-s", help="Change one setting, e.g. matching.sad.window_px=9. May be repeated."
    ),
]
Matcher = Annotated[
    str | None,
    typer.Option(
        "--matcher",
        help="Matcher: sad, sgm, opencv-bm, opencv-sgbm, onnx, or one of an installed plug-in.",
        show_default="matching.matcher, sad unless changed",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as JSON and nothing else.")]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Show no progress: only results, warnings and errors.")
]
Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose",
        "-v",
        help="Also print the time spent in each stage; where standard error is no terminal, "
        "print progress there as JSON lines.",
    ),
]
Formats = Annotated[
    list[str] | None,
    typer.Option(
        "--format",
        "-f",
        help="Format of the mesh: ply, obj, stl or glb. May be repeated; PLY is always written.",
        show_default="ply",
    ),
]
Mesh = Annotated[bool, typer.Option(help="Reconstruct the surface mesh.")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Dask scheduler whose workers do the work, such as tcp://host:8786.",
        show_default="workers on this machine",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Processes that share the work; they need the extra cluster.",
        show_default="1: this process",
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        "--threads",
        min=1,
        help="Number of threads. Does not change the results.",
        show_default="all cores",
    ),
]
SOURCES_HELP = (
    "KITTI (odometry or raw), EuRoC or TUM sequence, folder with left and right images, video, "
    "ROS bag, MCAP file, or Middlebury scene."
)
SourceArgument = Annotated[Path | None, typer.Argument(help=SOURCES_HELP)]
SourceKind = Annotated[
    str | None,
    typer.Option(
        "--source",
        help="Kind of source: kitti, kitti-raw, euroc, tum, folders, video, bag or middlebury.",
        show_default="detected from its files",
    ),
]
Calib = Annotated[
    Path | None,
    typer.Option(
        "--calib", help="Calibration file.", show_default="the one that comes with the source"
    ),
]
LeftView = Annotated[
    str | None,
    typer.Option("--left", help="Left image folder or topic.", show_default="found by name"),
]
RightView = Annotated[
    str | None,
    typer.Option(
        "--right",
        help="Right image folder or topic, or the right video where SOURCE is the left one.",
        show_default="found by name",
    ),
]
Tolerance = Annotated[
    float | None,
    typer.Option(
        "--tolerance",
        help="Largest difference between the time stamps of a pair, in seconds.",
        show_default="0.01",
    ),
]

Start = Annotated[
    int | None,
    typer.Option("--start", help="First frame to use.", show_default="0"),
]
End = Annotated[
    int | None,
    typer.Option("--end", help="Frame at which to stop.", show_default="after the last"),
]
Stride = Annotated[
    int | None,
    typer.Option("--stride", help="Use every so many frames.", show_default="1"),
]


def parse_numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    """Parse an option that takes several numbers, separated by commas.

    Raises:
        SettingsError: One of them is not a number.
    """
    if text is None:
        return None
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError as error:
        raise SettingsError(
            "not numbers separated by commas", where=option, got=text, expected="0.1,0.2,0.5"
        ) from error


MemoryLimit = Annotated[
    str | None,
    typer.Option(
        "--memory-limit",
        help="Memory limit of the process, e.g. 2G or 1500M. A run that exceeds it stops and can "
        "be resumed.",
        show_default="none",
    ),
]
