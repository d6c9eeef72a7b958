"""`recon settings`: every setting with its default, unit, values and purpose."""

from __future__ import annotations

from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.show.tables import print_json


def settings(
    name: Annotated[
        str | None,
        typer.Argument(
            help="A setting, a group such as matching.sgm, or a part of a name.",
            show_default="all",
        ),
    ] = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the page docs/settings.md.")
    ] = False,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """List settings: name, default, unit, values, and what each does.

    Change one with --set name=value, several with --config FILE.

    Examples:
      recon settings matching.sgm
      recon settings voxel
    """
    with one_line_errors(quiet=quiet):
        from dataclasses import asdict

        from recon.commands.settings_list import list_settings, settings_page

        groups = list_settings(name)
    if json:
        print_json({"groups": [asdict(group) for group in groups]})
    elif markdown:
        typer.echo(settings_page(groups), nl=False)
    else:
        from recon.cli.show.tables import print_settings

        print_settings(groups)
