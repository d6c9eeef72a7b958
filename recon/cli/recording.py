"""`recon audit` and `recon capture`: check a recording; make one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import SourceOptions, Start
from recon.cli.errors import until_interrupted
from recon.cli.tables import print_figures, print_json
from recon.core.errors import SettingsError
from recon.core.text import is_count


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
    verbose: opt.Verbose = False,
    *,
    reading: SourceOptions,
    shared: opt.Asked,
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
    with shared.one_line_errors():
        from recon.cli.progress import announce
        from recon.commands.recording import run_audit
        from recon.io.atomic import check_targets
        from recon.report.audit_page import audit_lines
        from recon.sources.registry import open_source

        if mend is not None and shared.config is not None:
            check_targets([mend], [shared.config])
        settings = shared.settings()
        drive = open_source(source, reading.kind, settings.source)
        announce(drive, quiet=shared.quiet, verbose=verbose)
        found = run_audit(drive, settings, mend=mend, out=out)
    if shared.json:
        print_json(found.summary)
        return
    print_figures("", audit_lines(found.summary))
    for finding in found.findings:
        typer.echo(f"{'fatal' if finding.fatal else 'warning'}: {finding.text}")
    typer.echo(f"verdict: {found.verdict}")
    if out is not None:
        typer.echo(f"results: {out}")


def _size(text: str) -> dict[str, str]:
    width, _, height = text.partition("x")
    if not (is_count(width) and is_count(height)):
        raise SettingsError("cannot read this size", got=text, expected="WIDTHxHEIGHT: 1280x720")
    return {"capture.width_px": width, "capture.height_px": height}


@opt.takes_groups
def capture(
    left: Annotated[
        str,
        typer.Argument(help="Left camera (0, /dev/video0) or video, or one that has both views."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="New folder for the recording.")],
    right: Annotated[str | None, typer.Argument(help="Right camera or video.")] = None,
    calib: Annotated[
        Path | None, typer.Option("--calib", help="Calibration file to copy into the folder.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many pairs.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Stop after this many seconds.")] = None,
    size: Annotated[
        str | None, opt.setting(_size, help="Requested image size, e.g. 1280x720.")
    ] = None,
    rate: Annotated[
        float | None,
        opt.setting("capture.rate_hz", help="Requested frame rate, in frames per second."),
    ] = None,
    preview: Annotated[
        int | None, typer.Option(min=1, help="Update preview.jpg every N pairs.")
    ] = None,
    *,
    shared: opt.Asked,
) -> None:
    """Record a drive from two cameras, or from one that has both views side by side.

    Stop with Ctrl-C. The folder is valid at any moment, and recon map takes it
    as it is.

    Examples:
      recon capture 0 2 --out rides/today --calib stereo.yaml --size 1280x720
      recon capture /dev/video4 --out rides/today --set capture.suffix=jpg
    """
    with shared.one_line_errors():
        from recon.commands.recording import run_capture
        from recon.rig.capture import RecordingSettings

        known = shared.settings().capture
        limits = {"frames": frames, "seconds": seconds, "preview_every": preview}
        settings = RecordingSettings.parse({**dict(known), **limits})
        devices = [left] if right is None else [left, right]
        with until_interrupted() as stopped:
            summary = run_capture(devices, out, settings, calibration=calib, stopped=stopped)
    print_json(summary) if shared.json else print_figures("", summary)
