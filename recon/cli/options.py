"""The options that all commands share, each defined once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.errors import SettingsError

Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Result folder (outputs/<command>/<UTC stamp>)."),
]
Config = Annotated[
    Path | None,
    typer.Option("--config", "-c", help="YAML file of settings, such as a run's config.yaml."),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", help="One setting, as key=value: matching.sad.window_px=9."),
]
Matcher = Annotated[
    str | None,
    typer.Option(
        "--matcher",
        help="How to match: sad, sgm, opencv-bm, opencv-sgbm, onnx. [default: as configured]",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as JSON, nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Also print seconds per stage.")]
Mesh = Annotated[bool, typer.Option(help="Reconstruct a surface.")]
Threads = Annotated[
    int | None,
    typer.Option("--threads", min=1, help="Threads to use (all cores)."),
]
SOURCES_HELP = (
    "KITTI drive (odometry or raw), EuRoC or TUM folder, left and right folders, video, "
    "ROS bag or MCAP file, Middlebury scene."
)
SourceArgument = Annotated[Path | None, typer.Argument(help=SOURCES_HELP)]
SourceKind = Annotated[
    str | None,
    typer.Option(
        "--source",
        help="What the source is: kitti, kitti-raw, euroc, tum, folders, video, bag, middlebury. "
        "[default: told by its files]",
    ),
]
Calib = Annotated[
    Path | None, typer.Option("--calib", help="Calibration file. [default: that of the source]")
]
LeftView = Annotated[
    str | None, typer.Option("--left", help="Left folder or topic. [default: found by name]")
]
RightView = Annotated[
    str | None,
    typer.Option("--right", help="Right folder or topic; or the right video, SOURCE is the left."),
]
Tolerance = Annotated[
    float | None,
    typer.Option("--tolerance", help="Seconds that the stamps of a pair may differ. [0.01]"),
]


def parse_numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    """The numbers of an option that takes several, separated by commas.

    Raises:
        SettingsError: One of them is no number.
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
        help="Most memory that the process may take, such as 2G or 1500M; what cannot keep to it "
        "stops and can be resumed. [default: no limit]",
    ),
]
