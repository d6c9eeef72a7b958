"""`recon demo`: the whole pipeline on a rendered street, compared with ground truth."""

from __future__ import annotations

from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.tables import print_json
from recon.core.text import counted


@opt.takes_groups
def demo(
    out: opt.Out = None,
    frames: Annotated[
        int | None, opt.setting("street.frames", min=1, help="Number of frames.", show_default="40")
    ] = None,
    seed: Annotated[
        int | None, opt.setting("street.seed", min=0, help="Seed of the street.", show_default="0")
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

        settings, viewer = shared.settings(), shared.viewer()
        run = run_demo(settings, out=out, mesh=mesh, threads=shared.threads, progress=viewer)
    shared.show(run.summary)


def doctor(
    compile_: Annotated[
        bool,
        typer.Option("--compile", help="Compile the kernels now, instead of checking anything."),
    ] = False,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Check the installation: Python, packages, system libraries, kernels, memory, folders.

    Exits with 1 if something is missing that runs need. With --compile, the
    kernels are compiled, which the first command that needs them does otherwise.

    Examples:
      recon doctor
      recon doctor --json
      recon doctor --compile
    """
    if compile_:
        _compile(json=json, quiet=quiet)
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


def _compile(*, json: bool, quiet: bool) -> None:
    with one_line_errors(quiet=quiet):
        from recon.commands.demo import compile_kernels

        done = compile_kernels()
    if json:
        print_json({"kernels": done.kernels, "seconds": round(done.seconds, 1)})
    elif done.kernels:
        typer.echo(f"{counted(done.kernels, 'kernel')} compiled in {done.seconds:.0f} s, and kept")
    else:
        typer.echo("the kernels are compiled already")


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

        from recon.commands.config import list_settings, settings_page

        groups = list_settings(name)
    if json:
        print_json({"groups": [asdict(group) for group in groups]})
    elif markdown:
        typer.echo(settings_page(groups), nl=False)
    else:
        from recon.cli.tables import print_settings

        print_settings(groups)
