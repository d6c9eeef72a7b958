"""`recon doctor`: check the installation."""

from __future__ import annotations

import typer

from recon.cli.options import Json, Quiet
from recon.cli.session import print_json, session


def doctor(json: Json = False, quiet: Quiet = False) -> None:
    """Check the installation: Python, packages, system libraries, memory, folders.

    Exits with 1 if something is missing that runs need.

    Examples:
      recon doctor
      recon doctor --json
    """
    with session(quiet=quiet):
        from dataclasses import asdict

        from recon.pipeline.doctor import Check, examine

        checks: list[Check] = examine()
    missing = [check for check in checks if check.needed and not check.ok]
    if json:
        print_json({"ok": not missing, "checks": [asdict(check) for check in checks]})
    else:
        from recon.viewers.checks import print_checks

        print_checks(checks)
    if missing:
        raise typer.Exit(1)
