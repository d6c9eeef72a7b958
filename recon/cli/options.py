"""Options shared by commands, each defined once; those of nearly every command as one value."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from recon.cli.errors import one_line_errors
from recon.cli.tables import print_json, print_run
from recon.core.errors import SettingsError
from recon.core.text import parse_number

if TYPE_CHECKING:
    from recon.map.sessions.measured import Survey
    from recon.run.progress import Progress

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
Antenna = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z",
        help="Where that antenna or prism is, from the left camera: metres forward, left, up.",
        show_default="0,0,0",
    ),
]
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


def parse_numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    """Parse an option that takes several numbers, separated by commas."""
    if text is None:
        return None
    try:
        return tuple(map(parse_number, text.split(",")))
    except ValueError as error:
        raise SettingsError(
            "not numbers separated by commas", where=option, got=text, expected="0.1,0.2,0.5"
        ) from error


def survey_of(positions: Path | None, antenna: str | None, crs: str | None = None) -> Survey | None:
    """Return what the options say of a survey."""
    from recon.map.sessions.measured import Survey

    if positions is None:
        if antenna is None and crs is None:
            return None
        given = "--crs" if antenna is None else "--antenna"
        raise SettingsError(
            "there are no positions that it describes", where=given, expected="--georeference FILE"
        )
    offset = parse_numbers(antenna or "0,0,0", "--antenna")
    if offset is None or len(offset) != 3 or not all(map(math.isfinite, offset)):
        raise SettingsError("not three numbers", where="--antenna", got=antenna, expected="X,Y,Z")
    return Survey(positions, (offset[0], offset[1], offset[2]), crs)


@dataclass(frozen=True)
class Shared:
    """What nearly every command takes, last in its help: settings, threads, and what is shown."""

    config: Config = None
    set_: Set = None
    json: Json = False
    quiet: Quiet = False
    verbose: Verbose = False
    threads: Threads = None

    @property
    def changes(self) -> Sequence[str]:
        """The settings of ``--set``."""
        return self.set_ or ()

    def one_line_errors(self) -> AbstractContextManager[None]:
        """Return what the body of the command runs in; see `recon.cli.errors`."""
        return one_line_errors(quiet=self.quiet)

    def viewer(self) -> Progress:
        """Choose what shows the progress."""
        from recon.cli.progress import choose_viewer

        return choose_viewer(quiet=self.quiet, verbose=self.verbose)

    def show(self, summary: Mapping[str, Any]) -> None:
        """Print the figures of a run."""
        print_json(summary) if self.json else print_run(summary, stages=self.verbose)


def takes_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Let typer see the options of groups, such as `Shared`, one by one.

    The command gets each group, a dataclass, as one value.
    """
    own = inspect.signature(command, eval_str=True)
    kinds: dict[str, Any] = {name: one.annotation for name, one in own.parameters.items()}
    groups: dict[str, Any] = {name: kind for name, kind in kinds.items() if is_dataclass(kind)}
    named = {name: [field.name for field in fields(group)] for name, group in groups.items()}
    options = [one for name, one in own.parameters.items() if name not in groups]
    for group in groups.values():
        hints = get_type_hints(group, None, None, True)
        for field in fields(group):
            one = inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY)
            options.append(one.replace(default=field.default, annotation=hints[field.name]))

    @wraps(command)
    def with_options(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{each: given.pop(each) for each in named[name]})
        command(**given)

    seen: Any = with_options
    seen.__signature__ = own.replace(parameters=options)
    return with_options
