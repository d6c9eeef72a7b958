"""What needs no recording: `recon demo`, `doctor`, `settings`, and `datasets`, which gets some."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.options import Commands
from recon.cli.tables import print_datasets, print_json
from recon.core.text import counted


@opt.takes_groups
def demo(
    out: opt.Out = None,
    frames: Annotated[
        int | None, opt.setting("street.frames", "Number of frames.", default="40", min=1)
    ] = None,
    seed: Annotated[
        int | None, opt.setting("street.seed", "Seed of the street.", default="0", min=0)
    ] = None,
    mesh: opt.Mesh = True,
    *,
    shared: opt.Shared,
) -> None:
    """Render a synthetic street drive, map it and compare the result with the truth.

    Needs no data. The results are those of recon map.

    Examples:
      recon demo
      recon demo --frames 60 --seed 3 --out outputs/street
    """
    with shared.one_line_errors():
        from recon.commands.demo import run_demo

        run = run_demo(shared.settings(), out=out, mesh=mesh, threads=shared.threads)
    shared.show(run.summary)


def doctor(
    compile_: Annotated[
        bool, opt.option("Compile the kernels now, instead of checking anything.", "--compile")
    ] = False,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Check the installation: Python, packages, system libraries, kernels, memory, folders.

    Exits with 1 if something is missing that runs need. With --compile, all
    kernels are compiled; otherwise each command compiles those that it needs.

    Examples:
      recon doctor
      recon doctor --json
      recon doctor --compile
    """
    if compile_:
        with one_line_errors(quiet=quiet):
            from recon.commands.kernels import compile_kernels

            begun = time.perf_counter()
            kernels = compile_kernels()
        seconds = time.perf_counter() - begun
        text = f"{counted(kernels, 'kernel')} compiled in {seconds:.0f} s, and kept"
        if json:
            print_json({"kernels": kernels, "seconds": round(seconds, 1)})
        else:
            typer.echo(text if kernels else "the kernels are compiled already")
        return
    with one_line_errors(quiet=quiet):
        from dataclasses import asdict

        from recon.commands.doctor import examine

        checks = examine()
    missing = [check for check in checks if check.needed and not check.ok]
    if json:
        print_json({"ok": not missing, "checks": [asdict(check) for check in checks]})
    else:
        from recon.cli.tables import print_checks

        print_checks(checks)
    if missing:
        raise typer.Exit(1)


def settings(
    name: Annotated[
        str | None,
        typer.Argument(
            help="A setting, a group such as matching.onnx, or a part of a name.",
            show_default="all",
        ),
    ] = None,
    preset: Annotated[
        str | None,
        opt.option(
            "Print a preset, as a file for --config: fast, robot, survey, room or small.",
            "--preset",
            metavar="PRESET",
        ),
    ] = None,
    markdown: Annotated[bool, opt.option("Print the page docs/settings.md.", "--markdown")] = False,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """List settings: name, default, unit, values, and what each does.

    Change one with --set name=value, several with --config FILE.

    Examples:
      recon settings matching.onnx
      recon settings voxel
      recon settings --preset robot > robot.yaml
    """
    with one_line_errors(quiet=quiet):
        from dataclasses import asdict

        from recon.commands.config import (
            list_settings,
            preset_text,
            preset_values,
            settings_page,
        )

        text = None if preset is None else preset_text(preset)
        groups = list_settings(name)
    if text is not None:
        print_json(dict(preset_values(preset))) if json else typer.echo(text, nl=False)
        return
    if json:
        print_json({"groups": [asdict(group) for group in groups]})
    elif markdown:
        typer.echo(settings_page(groups), nl=False)
    else:
        from recon.cli.tables import print_settings

        print_settings(groups)


datasets = Commands(
    name="datasets",
    no_args_is_help=True,
    help="Public data that recon reads: Middlebury, KITTI, EuRoC, TUM VI.",
)
Names = Annotated[
    list[str],
    typer.Argument(metavar="NAME...", help="Data sets, or parts: kitti-raw/2011_09_26_drive_0013."),
]
Folder = Annotated[Path, opt.option("Where data sets are kept.", "--folder")]
_FOLDER = Path("datasets")


@datasets.command("list")
def list_(
    name: Annotated[
        str | None, typer.Argument(help="A data set, to list its parts.", show_default="all")
    ] = None,
    folder: Folder = _FOLDER,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """List the data sets with size, licence and what is there already.

    With a name, also its parts, what to cite, how its folder is laid out, and
    the command that reads it.

    Examples:
      recon datasets list
      recon datasets list kitti-raw
    """
    with one_line_errors(quiet=quiet):
        from recon.commands.datasets import run_list

        found = run_list(name, folder)
    print_json(found) if json else print_datasets(found)


@datasets.command()
def fetch(
    names: Names,
    folder: Folder = _FOLDER,
    address: Annotated[
        str | None,
        opt.option(
            "A mirror: a folder on a server that has the archives by their names.", metavar="URL"
        ),
    ] = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Download, check and unpack data sets as recon reads them.

    A download that broke off goes on where it was. What is there already is
    left alone. The terms of the owners hold; `recon datasets list` shows them.

    Examples:
      recon datasets fetch middlebury-eval3/Q
      recon datasets fetch kitti-raw/2011_09_26_drive_0013 tum-vi/room1
      recon datasets fetch euroc/vicon_room1 --address http://mirror.example/data
    """
    with one_line_errors(quiet=quiet, verbose=verbose):
        from recon.commands.datasets import run_fetch

        found = run_fetch(names, folder, address=address)
    print_json(found) if json else print_datasets(found)


@datasets.command()
def verify(
    names: Names, folder: Folder = _FOLDER, json: opt.Json = False, quiet: opt.Quiet = False
) -> None:
    """Compare the files of fetched data sets with what was unpacked.

    The first file that is missing or has changed is an error; of a data set
    with parts, those that were fetched are compared.

    Examples:
      recon datasets verify middlebury-eval3/Q
    """
    with one_line_errors(quiet=quiet):
        from recon.commands.datasets import run_verify

        found = run_verify(names, folder)
    print_json(found) if json else print_datasets(found)
