"""`recon demo`: the whole pipeline on a rendered street, compared with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from recon.commands.config import ReconConfig
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.export.map_run import MapRun
from recon.map.fusion.builder import fusion_range_m
from recon.run.progress import SILENT, Progress
from recon.sources.synthetic import SyntheticSource
from recon.street.street import rig

FARTHEST_M: Final = 30.0


def run_demo(
    config: ReconConfig,
    *,
    out: Path | None = None,
    mesh: bool = True,
    threads: int | None = None,
    progress: Progress = SILENT,
) -> MapRun:
    """Render a street and map it: what `recon demo` does.

    Args:
        config: The configuration; ``street`` says what is rendered.
        out: As for `run_map`.
        mesh: As for `run_map`.
        threads: As for `run_map`.
        progress: As for `run_map`.
    """
    options = MapOptions(
        command="demo",
        out=out,
        threads=threads,
        mesh=mesh,
        progress=progress,
        audit=False,
    )
    return run_map(demo_source(config), config, options)


def demo_source(config: ReconConfig) -> SyntheticSource:
    """Return a street whose true surface extends as far as the map does.

    Surfaces beyond the range limit are not fused, so the ground truth leaves them out.
    """
    range_m = fusion_range_m(rig(config.street), config.fusion)
    return SyntheticSource(config.street, surface_range_m=min(range_m, FARTHEST_M))
