"""`recon audit`: check a recording before a long run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import (
    SOURCES_HELP,
    Calib,
    Config,
    End,
    Json,
    LeftView,
    Quiet,
    RightView,
    Set,
    SourceKind,
    Start,
    Stride,
    Tolerance,
    Verbose,
)
from recon.cli.session import print_figures, print_json, session


def audit(
    source: Annotated[Path, typer.Argument(help=SOURCES_HELP)],
    mend: Annotated[
        Path | None,
        typer.Option(help="Write a calibration with corrected row alignment to this file."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for a report with images.", show_default="none"),
    ] = None,
    kind: SourceKind = None,
    calib: Calib = None,
    left: LeftView = None,
    right: RightView = None,
    tolerance: Tolerance = None,
    start: Start = None,
    end: End = None,
    stride: Stride = None,
    config: Config = None,
    set_: Set = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Check a recording before a long run: good, usable or not usable, and why.

    Looks at row alignment, swapped, delayed or frozen cameras, missing and
    repeated frames, exposure, focus and baseline, and predicts the depth error.
    With --out, sample pairs, row errors and disparities are drawn in a report.

    Examples:
      recon audit drive.bag --calib camchain.yaml
      recon audit rides/today --mend mended.yaml
      recon audit rides/today --out audited
    """
    with session(quiet=quiet):
        from recon.cli.show import announce
        from recon.commands.audit import write_audit
        from recon.commands.config import load_config, source_overrides
        from recon.report.audit_table import audit_lines
        from recon.rig.audit.run import mend_calibration, run_audit
        from recon.sources import open_source

        asked = source_overrides(calib, left, right, tolerance, (start, end, stride))
        settings = load_config(config, [*(set_ or ()), *asked])
        drive = open_source(source, kind, settings.source)
        announce(drive, quiet=quiet, verbose=verbose)
        found = run_audit(drive, settings)
        summary = found.summary
        if mend is not None:
            summary["mended"] = mend_calibration(drive, settings, found, mend)
        if out is not None:
            write_audit(found, drive, settings, out)
    if json:
        print_json(summary)
        return
    print_figures("", audit_lines(summary))
    for finding in found.findings:
        typer.echo(f"{'fatal' if finding.fatal else 'warning'}: {finding.text}")
    typer.echo(f"verdict: {found.verdict}")
    if out is not None:
        typer.echo(f"results: {out}")
