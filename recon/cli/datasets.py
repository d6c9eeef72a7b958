"""`recon datasets`: public data that recon reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.options import Commands
from recon.cli.tables import print_datasets, print_json

app = Commands(
    no_args_is_help=True,
    help="Public data that recon reads: Middlebury, KITTI, EuRoC, TUM VI.",
)
Names = Annotated[
    list[str],
    typer.Argument(metavar="NAME...", help="Data sets, or parts: kitti-raw/2011_09_26_drive_0013."),
]
Folder = Annotated[Path, typer.Option("--folder", help="Where data sets are kept.")]
_FOLDER = Path("datasets")


@app.command("list")
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


@app.command()
def fetch(
    names: Names,
    folder: Folder = _FOLDER,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="A mirror: a folder on a server that has the archives by their names.",
            show_default="the owners' server",
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
    with one_line_errors(quiet=quiet):
        from recon.cli.progress import choose_viewer
        from recon.commands.datasets import run_fetch

        viewer = choose_viewer(quiet=quiet, verbose=verbose)
        found = run_fetch(names, folder, address=address, progress=viewer)
    print_json(found) if json else print_datasets(found)


@app.command()
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
