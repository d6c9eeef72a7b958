"""`recon evaluate disparity`: one map against its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import Json
from recon.cli.session import print_figures, print_json, session


def disparity(
    estimate: Annotated[Path, typer.Argument(help="PFM, or 16-bit PNG as KITTI's.")],
    truth: Annotated[Path, typer.Argument(help="The true one, in either format.")],
    mask: Annotated[
        Path | None, typer.Option(help="Picture that is 255 where pixels are compared.")
    ] = None,
    scale: Annotated[
        float,
        typer.Option(min=1e-3, help="Figures in pixels so much finer: 4 for quarter-size maps."),
    ] = 1.0,
    confidence: Annotated[
        Path | None, typer.Option(help="PFM of the map's confidence, to see whether it is true.")
    ] = None,
    json: Json = False,
) -> None:
    """Middlebury's figures and KITTI's D1 of one disparity map, as found and with holes filled.

    Example: recon evaluate disparity outputs/disparity/latest/disparity/disparity.pfm disp0GT.pfm
    """
    with session():
        from recon.pipeline.evaluate_run import compare_disparities

        figures = compare_disparities(estimate, truth, mask, scale=scale, confidence=confidence)
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
