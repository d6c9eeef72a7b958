"""`recon demo`: the whole pipeline on a rendered street, compared with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from recon.commands.config import ReconConfig
from recon.commands.kernels import compile_kernels
from recon.commands.map import MapResult, run_map
from recon.commands.map_options import MapOptions
from recon.map.fusion import fusion_range_m
from recon.sources.synthetic import SyntheticSource
from recon.street.street import rig

FARTHEST_M: Final = 30.0


def run_demo(
    config: ReconConfig,
    *,
    out: Path | None = None,
    mesh: bool = True,
    threads: int | None = None,
) -> MapResult:
    """Render the street of the configuration and map it: what `recon demo` does."""
    compile_kernels("demo", config.matching.matcher)
    options = MapOptions("demo", out, threads, mesh=mesh, audit=False)
    return run_map(demo_source(config), config, options)


def demo_source(config: ReconConfig) -> SyntheticSource:
    """Return a street whose true surface extends as far as the map: what is fused of it."""
    range_m = fusion_range_m(rig(config.street), config.fusion)
    return SyntheticSource(config.street, surface_range_m=min(range_m, FARTHEST_M))
