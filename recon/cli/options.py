"""Options shared by commands, each defined once; those of nearly every command as one value.

An option that stands for a setting names it with `setting`, and nothing else has to be written:
`takes_groups` gathers what was given, and ``changes`` of the command's `Asked` has it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_origin, get_type_hints

import typer
from typer.core import TyperCommand

from recon.cli.errors import one_line_errors
from recon.cli.tables import print_summary
from recon.core.errors import SettingsError
from recon.core.text import parse_number, refuse_other_numbers

if TYPE_CHECKING:
    from recon.commands.config import Changes, ReconConfig
    from recon.commands.map_options import MapOptions
    from recon.core.summary import Summary
    from recon.map.sessions.measured import Survey

_KEYWORD: Final = inspect.Parameter.KEYWORD_ONLY
Read = str | Callable[[Any], Mapping[str, Any]]
"""The setting that an option stands for; or what makes of its value settings with theirs."""


def option(text: str, *names: str, default: str | None = None, **how: Any) -> Any:
    """Declare an option, as `typer.Option` does, by its help and the default that this shows."""
    return typer.Option(*names, help=text, show_default=default or True, **how)


def setting(read: Read, text: str, *names: str, **how: Any) -> Any:
    """Declare an option that stands for a setting."""
    declared = option(text, *names, **how)
    declared.setting = read
    return declared


Out = Annotated[
    Path | None,
    option("Folder for the results.", "--out", "-o", default="outputs/<command>/<UTC time stamp>"),
]
Config = Annotated[
    Path | None,
    option("YAML file with settings, such as the config.yaml of a run.", "--config", "-c"),
]
Preset = Annotated[
    str | None,
    option(
        "Settings chosen together: fast, robot, survey, room or small; --config and --set come "
        "after it. recon settings --preset NAME shows them.",
        "--preset",
        metavar="NAME",
    ),
]
Set = Annotated[
    list[str] | None,
    option(
        "Change a setting, as scene.scale=0.1. Several with commas: a.b=1,c.d=2.", "--set", "-s"
    ),
]
Matcher = Annotated[
    str | None,
    setting(
        "matching.matcher",
        "sad, sgm, fine, opencv-bm, opencv-sgbm, onnx, plug-in.",
        default="sad; fine for one pair",
    ),
]
Json = Annotated[bool, option("Print the summary as JSON and nothing else.", "--json")]
Quiet = Annotated[
    bool, option("Show no progress: only results, warnings and errors.", "--quiet", "-q")
]
Verbose = Annotated[
    bool,
    option(
        "Print all figures, too; progress as JSON lines where there is no bar.", "--verbose", "-v"
    ),
]
Formats = Annotated[
    list[str] | None,
    option("Format of the mesh besides PLY: obj, stl or glb. May be repeated.", "--format", "-f"),
]
To = Annotated[
    list[str] | None,
    option(
        "mcap: also a bag of ROS 2 with frames, poses and the map, as they come.", metavar="mcap"
    ),
]
Mesh = Annotated[bool, option("Reconstruct the surface mesh.")]
Compared = Annotated[
    bool,
    option("Report what came and went with the newest drive (takes as long as recon diff)."),
]
Antenna = Annotated[
    str | None,
    option("Antenna or prism, from the left camera: metres forward, left, up.", metavar="X,Y,Z"),
]
Scheduler = Annotated[
    str | None,
    option("Dask scheduler whose workers do the work, e.g. tcp://host:8786.", metavar="ADDRESS"),
]
Workers = Annotated[
    int | None,
    option("Processes that share the work; they need the extra cluster.", default="1", min=1),
]
Threads = Annotated[
    int | None,
    option("Number of threads. Does not change the results.", default="all cores", min=1),
]
POSITIONS = (
    " NMEA, RTKLIB, an OXTS folder, a ROS bag with NavSatFix (BAG or BAG:/TOPIC), rows of time, "
    "easting, northing, height (s, m), or a header; for export also control points."
)
SOURCES_HELP = (
    "KITTI (odometry or raw), EuRoC or TUM sequence, folder with left and right images, video, "
    "ROS bag, MCAP file, or Middlebury scene."
)


def names_in(texts: Sequence[str] | None) -> list[str]:
    """Return the names that an option was given, several with commas or once each."""
    return [name.strip() for text in texts or () for name in text.split(",")]


def is_bag(to: Sequence[str] | None) -> bool:
    """Return whether a bag is to be written while a drive goes on, which is all there is."""
    names = set(names_in(to))
    if names - {"mcap"}:
        what, hint = "not written while a drive goes on", "recon export makes it of the run"
        raise SettingsError(what, where="--to", got=",".join(names), expected="mcap", hint=hint)
    return bool(names)


def parse_numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    """Parse an option that takes several numbers, separated by commas."""
    if text is None:
        return None
    try:
        return tuple(map(parse_number, text.split(",")))
    except ValueError as error:
        what, expected = "not numbers separated by commas", "0.1,0.2,0.5"
        raise SettingsError(what, where=option, got=text, expected=expected) from error


def survey_of(positions: Path | None, antenna: str | None, crs: str | None = None) -> Survey | None:
    """Return what the options say of a survey."""
    from recon.map.sessions.measured import Survey

    if positions is None:
        for given, value in (("--antenna", antenna), ("--crs", crs)):
            if value is not None:
                what, expected = "there are no positions that it describes", "--georeference FILE"
                raise SettingsError(what, where=given, expected=expected)
        return None
    offset = parse_numbers(antenna or "0,0,0", "--antenna")
    if offset is None or len(offset) != 3 or not all(map(math.isfinite, offset)):
        raise SettingsError("not three numbers", where="--antenna", got=antenna, expected="X,Y,Z")
    return Survey(positions, (offset[0], offset[1], offset[2]), crs)


@dataclass(frozen=True)
class Asked:
    """What commands with settings take, last in their help."""

    config: Config = None
    preset: Preset = None
    set_: Set = None
    json: Json = False
    quiet: Quiet = False
    given: Sequence[tuple[Read, Any]] = ()
    """What was given of the options that stand for settings; no option itself."""

    @property
    def changes(self) -> Changes:
        """The settings of ``--set``, and then those of options."""
        read = (
            {one: str(value) if isinstance(value, Path) else value}
            if isinstance(one, str)
            else one(value)
            for one, value in self.given
        )
        return [*(self.set_ or ()), *read]

    def settings(self, defaults: Mapping[str, Any] | None = None) -> ReconConfig:
        from recon.commands.config import load_config

        return load_config(self.config, self.changes, defaults, preset=self.preset)

    def one_line_errors(self) -> AbstractContextManager[None]:
        return one_line_errors(quiet=self.quiet)


@dataclass(frozen=True)
class Shared(Asked):
    """What nearly every command takes: also threads, and what is shown."""

    verbose: Verbose = False
    threads: Threads = None

    def one_line_errors(self) -> AbstractContextManager[None]:
        return one_line_errors(quiet=self.quiet, verbose=self.verbose)

    def options(
        self, command: str = "map", out: Path | None = None, *, view: bool = False, **more: Any
    ) -> MapOptions:
        """Return the options of a run that maps, which the browser may ``view`` meanwhile."""
        from recon.cli.view import view_beside
        from recon.commands.map_options import MapOptions

        options = MapOptions(command, out, self.threads, **more)
        return replace(options, begun=view_beside) if view else options

    def show(self, summary: Summary) -> None:
        print_summary(summary, as_json=self.json, verbose=self.verbose)


def takes_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Let typer see the options of groups, such as `Shared`, one by one.

    The command gets each group, a dataclass, as one value; that of `Asked` has what was given of
    all options that stand for a setting.
    """
    own = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {
        n: p.annotation for n, p in own.parameters.items() if is_dataclass(p.annotation)
    }
    options = [one for name, one in own.parameters.items() if name not in groups]
    members = {name: _options_of(group) for name, group in groups.items()}
    options += [option for inside in members.values() for option in inside]
    settings = {one.name: read for one in options if (read := _setting_of(one))}

    @wraps(command)
    def with_options(**values: Any) -> None:
        named = ((read, values[name]) for name, read in settings.items())
        # A flag that is not set says nothing.
        given = [(read, v) for read, v in named if v is not None and v is not False]
        for name, group in groups.items():
            inside = {option.name: values.pop(option.name) for option in members[name]}
            values[name] = group(**inside, **({"given": given} if issubclass(group, Asked) else {}))
        command(**values)

    seen: Any = with_options
    seen.__signature__ = own.replace(parameters=options)
    return with_options


def _options_of(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, None, None, True)
    return [
        inspect.Parameter(one.name, _KEYWORD, default=one.default, annotation=hints[one.name])
        for one in fields(group)
        if get_origin(hints[one.name]) is Annotated
    ]


def _setting_of(option: inspect.Parameter) -> Read | None:
    marks = getattr(option.annotation, "__metadata__", ())
    return next((mark.setting for mark in marks if hasattr(mark, "setting")), None)


class Commands(typer.Typer):
    """A program, or a part of one, whose options take ASCII decimals alone for numbers."""

    def command(self, name: str | None = None, **how: Any) -> Callable[[Any], Any]:
        """Return the decorator that makes a function a command, see `typer.Typer.command`."""
        return super().command(name, cls=_Command, **how)


class _Command(TyperCommand):
    """A command that looks at the text of each number, see `recon.core.text`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        texts, _, _ = self.make_parser(ctx).parse_args([*args])
        left = super().parse_args(ctx, args)
        param: Any  # a class of typer's own
        for param in self.params:
            text = texts.get(param.name)
            if isinstance(text, str) and isinstance(ctx.params.get(param.name), int | float):
                try:
                    refuse_other_numbers(text)
                except ValueError as error:
                    raise typer.BadParameter(str(error), ctx, param) from error
        return left
