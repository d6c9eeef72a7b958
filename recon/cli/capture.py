"""`recon capture`: record two cameras into a folder that `recon map` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.interrupt import until_interrupted
from recon.cli.show.tables import print_figures, print_json


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
    size: Annotated[str | None, typer.Option(help="Requested image size, e.g. 1280x720.")] = None,
    rate: Annotated[
        float | None, typer.Option(help="Requested frame rate, in frames per second.")
    ] = None,
    preview: Annotated[
        int | None, typer.Option(min=1, help="Update preview.jpg every N pairs.")
    ] = None,
    config: opt.Config = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
) -> None:
    """Record a drive from two cameras, or from one that has both views side by side.

    Stop with Ctrl-C. The folder is valid at any moment, and recon map takes it
    as it is.

    Examples:
      recon capture 0 2 --out rides/today --calib stereo.yaml --size 1280x720
      recon capture /dev/video4 --out rides/today --set capture.suffix=jpg
    """
    with one_line_errors(quiet=quiet):
        from recon.cli.overrides import capture_overrides
        from recon.commands.capture import run_capture
        from recon.commands.config import load_config
        from recon.rig.capture import RecordingSettings

        known = load_config(config, [*(set_ or ()), *capture_overrides(size, rate)]).capture
        limits = {"frames": frames, "seconds": seconds, "preview_every": preview}
        settings = RecordingSettings.parse({**dict(known), **limits})
        devices = [left] if right is None else [left, right]
        with until_interrupted() as stopped:
            summary = run_capture(devices, out, settings, calibration=calib, stopped=stopped)
    print_json(summary) if json else print_figures("", summary)
