"""`recon demo`: the whole pipeline on a rendered street, compared with ground truth."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.commands.export import run_occupancy
from recon.commands.map import MapRun, run_map
from recon.commands.map_options import MapOptions
from recon.commands.pair import run_pair
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.kernels.cache import when_compiling
from recon.core.values import StereoPair
from recon.io.models.octomap import read_octomap
from recon.map.drive.sequence import map_sequence
from recon.map.fusion import fusion_range_m
from recon.map.tiles import Tiles
from recon.run.finished import OCTOMAP
from recon.sources.one_pair import PairInput
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.stereo.match.registry import MATCHERS
from recon.street.street import rig

FARTHEST_M: Final = 30.0


def run_demo(
    config: ReconConfig,
    *,
    out: Path | None = None,
    mesh: bool = True,
    threads: int | None = None,
) -> MapRun:
    """Render the street of the configuration and map it: what `recon demo` does."""
    options = MapOptions("demo", out, threads, mesh=mesh, audit=False)
    return run_map(demo_source(config), config, options)


def demo_source(config: ReconConfig) -> SyntheticSource:
    """Return a street whose true surface extends as far as the map: what is fused of it."""
    range_m = fusion_range_m(rig(config.street), config.fusion)
    return SyntheticSource(config.street, surface_range_m=min(range_m, FARTHEST_M))


_MATCHERS: Final = tuple(name for name in MATCHERS if name != "onnx")  # it needs a network
_SMALL: Final = (
    "street.frames=6", "street.width_px=192", "street.height_px=96", "street.focal_px=120",
    "submaps.length_m=2",
)  # fmt: skip


def compile_kernels() -> dict[str, Any]:
    """Compile the kernels that pairs, drives and occupancy maps run, for all matchers of ours.

    The real stages run once, on small rendered images. Returned is how many ``kernels`` were not in
    the cache, and how many ``seconds`` it took.
    """
    begun, compiled = time.perf_counter(), set[str]()
    with when_compiling(compiled.add), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = load_config(None, _SMALL)
        source = demo_source(config)
        options = MapOptions("demo", folder / "drive", audit=False)
        run_map(source, config, options)
        run_occupancy(folder / "drive", out=folder / "occupancy")
        read_octomap(folder / "drive" / OCTOMAP)  # as an evaluation does
        # Submaps are moved as closed loops do it, of which so small a drive has none.
        mapped = map_sequence(source, config)
        turn = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.zeros(3))
        submaps = mapped.session.submaps
        turns = np.stack([turn] * len(submaps))
        len(Tiles.of_submaps(submaps, mapped.config, mapped.T_map_world, turns))
        colour = next(source.frames())
        grey = StereoPair(*(image[:, :, 1].copy() for image in (colour.left, colour.right)))
        for kind, pair in {"colour": colour, "grey": grey}.items():
            run_pair(PairInput(pair, source.calibration), out=folder / kind)
            for matcher in _MATCHERS:
                config = load_config(None, [f"matching.matcher={matcher}"], PAIR_DEFAULTS)
                FrameReconstructor(source.calibration, config).reconstruct(pair)
    seconds = round(time.perf_counter() - begun, 1)
    return {"kernels": len(compiled), "seconds": seconds}
