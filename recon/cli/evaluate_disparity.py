"""`recon evaluate disparity`: compare a disparity map with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import Json, Quiet
from recon.cli.session import session
from recon.cli.show.tables import print_figures, print_json


def disparity(
    estimate: Annotated[
        Path, typer.Argument(help="Disparity map: PFM, or 16-bit PNG as used by KITTI.")
    ],
    truth: Annotated[Path, typer.Argument(help="Ground truth, in either format.")],
    mask: Annotated[
        Path | None, typer.Option(help="Image that is 255 at the pixels to compare.")
    ] = None,
    scale: Annotated[
        float,
        typer.Option(
            min=1e-3,
            help="Scale of the reported errors: 4 reports a quarter-size map at full size.",
        ),
    ] = 1.0,
    confidence: Annotated[
        Path | None, typer.Option(help="Confidence of the map (PFM), to be evaluated too.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare a disparity map with ground truth: Middlebury's measures and KITTI's D1.

    Reported for the pixels that have a value (sparse) and with holes filled
    (dense).

    Examples:
      recon evaluate disparity disparity.pfm disp0GT.pfm
      recon evaluate disparity disparity.pfm disp0GT.pfm --mask mask0nocc.png
    """
    with session(quiet=quiet):
        from recon.commands.evaluate_disparity import run_evaluate_disparity

        figures = run_evaluate_disparity(estimate, truth, mask, scale=scale, confidence=confidence)
    if json:
        print_json(figures)
        return
    shown = {name: value for name, value in figures.items() if not isinstance(value, dict)}
    for kind in ("sparse", "dense"):
        flat = {f"bad {limit}": share for limit, share in figures[kind]["bad"].items()}
        shown |= {f"{kind} {name}": value for name, value in (flat | figures[kind]).items()}
    rated = figures.get("confidence", {})
    shown |= {f"confidence {name}": rated[name] for name in ("ece", "ause") if name in rated}
    print_figures(f"{estimate} against {truth}", shown)
