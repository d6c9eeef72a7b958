"""`recon audit`: check a recording before a long run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import SourceOptions, Start
from recon.cli.errors import one_line_errors
from recon.cli.show.tables import print_figures, print_json


@opt.takes_groups
def audit(
    source: Annotated[Path, typer.Argument(help=opt.SOURCES_HELP)],
    mend: Annotated[
        Path | None,
        typer.Option(help="Write a calibration that fits rows and motion to this file."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for a report with images.", show_default="none"),
    ] = None,
    start: Start = None,
    config: opt.Config = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
    *,
    reading: SourceOptions,
) -> None:
    """Check a recording before a long run: good, usable or not usable, and why.

    Looks at row alignment, swapped, delayed or frozen cameras, missing and
    repeated frames, exposure, focus and baseline, and predicts the depth error.
    The motion of the drive shows how the right camera is turned; not the scale.
    With --out, sample pairs, row errors and disparities are drawn in a report.

    Examples:
      recon audit drive.bag --calib camchain.yaml
      recon audit rides/today --mend mended.yaml
      recon audit rides/today --out audited
    """
    with one_line_errors(quiet=quiet):
        from recon.cli.show.announce import announce
        from recon.commands.audit import run_audit
        from recon.commands.config import load_config
        from recon.io.atomic import check_targets
        from recon.report.audit_page import audit_lines
        from recon.sources.registry import open_source

        if mend is not None and config is not None:
            check_targets([mend], [config])
        settings = load_config(config, [*(set_ or ()), *reading.overrides(start)])
        drive = open_source(source, reading.kind, settings.source)
        announce(drive, quiet=quiet, verbose=verbose)
        found = run_audit(drive, settings, mend=mend, out=out)
    if json:
        print_json(found.summary)
        return
    print_figures("", audit_lines(found.summary))
    for finding in found.findings:
        typer.echo(f"{'fatal' if finding.fatal else 'warning'}: {finding.text}")
    typer.echo(f"verdict: {found.verdict}")
    if out is not None:
        typer.echo(f"results: {out}")
