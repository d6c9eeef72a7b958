"""`recon doctor`: check the installation."""

from __future__ import annotations

from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.show.tables import print_json
from recon.core.text import counted


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
        from recon.cli.show.tables import print_checks

        print_checks(checks)
    if missing:
        raise typer.Exit(1)


def _compile(*, json: bool, quiet: bool) -> None:
    with one_line_errors(quiet=quiet):
        from recon.commands.warm_up import compile_kernels

        done = compile_kernels()
    if json:
        print_json({"kernels": done.kernels, "seconds": round(done.seconds, 1)})
    elif done.kernels:
        typer.echo(f"{counted(done.kernels, 'kernel')} compiled in {done.seconds:.0f} s, and kept")
    else:
        typer.echo("the kernels are compiled already")
