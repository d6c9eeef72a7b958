"""`recon pair` and `recon disparity`: process one stereo pair."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import RectifiedOptions
from recon.core.errors import SettingsError

if TYPE_CHECKING:
    from recon.commands.config import ReconConfig
    from recon.sources.settings import SourceSettings


def _settings(shared: opt.Shared, ndisp: int | None) -> ReconConfig:
    """Return the configuration of one pair, whose matcher has a number of disparities if given."""
    from recon.commands.config import PAIR_DEFAULTS
    from recon.core.plugins import name_of
    from recon.stereo.match.registry import settings_taken

    settings = shared.settings(PAIR_DEFAULTS)
    used = settings.matching.matcher
    if ndisp is not None and "ndisp" not in settings_taken(used):
        what, got = "the matcher has no such setting", f"matcher {name_of(used)!r}"
        raise SettingsError(what, where="--ndisp", got=got)
    return settings


def _readable(settings: ReconConfig, unit_m: float | None = None) -> SourceSettings:
    unit_m = unit_m or settings.source.metres_per_unit
    update = {"metres_per_unit": unit_m, "max_megapixels": settings.readable_megapixels}
    return settings.source.model_copy(update=update)


Left = Annotated[Path, typer.Argument(help="Left image.")]
Right = Annotated[Path, typer.Argument(help="Right image.")]
Ndisp = Annotated[
    int | None,
    opt.setting(
        "matching.ndisp",
        "Number of disparities to search.",
        default="calibration, else estimated",
        min=1,
    ),
]
Calib = Annotated[
    Path | None,
    opt.option(
        "Calibration file: OpenCV, NumPy, MATLAB, ROS, kalibr, KITTI, ZED and others. "
        "Without one, the pair must be rectified already."
    ),
]


@opt.takes_groups
def pair(
    left: Left,
    right: Right,
    calib: Calib = None,
    unit_m: Annotated[
        float | None,
        opt.option("Metres per unit in an OpenCV file, e.g. 0.001 for mm. [1]", min=1e-6),
    ] = None,
    truth: Annotated[
        Path | None, opt.option("Ground-truth disparity (PFM or 16-bit PNG) to compare with.")
    ] = None,
    out: opt.Out = None,
    formats: opt.Formats = None,
    matcher: opt.Matcher = None,
    ndisp: Ndisp = None,
    *,
    known: RectifiedOptions,
    shared: opt.Shared,
) -> None:
    """Reconstruct one stereo pair: disparity, depth, point cloud, mesh, report.

    The images may be raw or rectified; the calibration tells which. Without
    one they must be rectified, and the focal length is that of --focal or of
    the EXIF data. Pixels without a disparity have a reason code. What planes
    around say where nothing was measured is in files of its own; --set
    cloud.inferred=true makes points and surface of it, too.

    Examples:
      recon pair im0.png im1.png --calib calib.txt --out outputs/motorcycle
      recon pair im0.png im1.png --calib calib.txt --truth disp0GT.pfm
      recon pair im0.png im1.png --calib calib.txt --format glb
      recon pair left.png right.png --focal 721.5 --baseline 0.54
    """
    with shared.one_line_errors():
        from recon.commands.pair import run_pair
        from recon.sources.one_pair import read_pair_input, with_truth

        settings = _settings(shared, ndisp)
        given = read_pair_input(
            left,
            right,
            calib,
            known=settings.source,
            settings=_readable(settings, unit_m),
        )
        run = run_pair(
            with_truth(given, truth),
            settings,
            out=out,
            formats=opt.names_in(formats),
            threads=shared.threads,
        )
    shared.show(run.summary)


@opt.takes_groups
def disparity(
    left: Left,
    right: Right,
    calib: Calib = None,
    out: opt.Out = None,
    matcher: opt.Matcher = None,
    ndisp: Ndisp = None,
    *,
    shared: opt.Shared,
) -> None:
    """Compute the disparity of one pair: PFM, 16-bit PNG, confidence, reason codes.

    Unlike recon pair it needs no calibration if the pair is rectified. What
    planes around say where nothing was measured is in files of its own.

    Examples:
      recon disparity left.png right.png --ndisp 128
      recon disparity raw_left.png raw_right.png --calib rig.yaml --matcher sgm
    """
    with shared.one_line_errors():
        from recon.commands.pair import run_disparity
        from recon.sources.one_pair import read_pair_input

        settings = _settings(shared, ndisp)
        given = read_pair_input(
            left,
            right,
            calib,
            settings=_readable(settings),
        )
        run = run_disparity(given, settings, out=out, threads=shared.threads)
    shared.show(run.summary)
