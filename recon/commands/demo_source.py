"""The rendered street that `recon demo` maps."""

from __future__ import annotations

from typing import Final

from recon.commands.config import ReconConfig
from recon.map import fusion_range_m
from recon.sources.synthetic import SyntheticSource
from recon.street.street import rig

FARTHEST_M: Final = 30.0


def demo_source(config: ReconConfig) -> SyntheticSource:
    """A street whose true surface extends as far as the map does.

    Surfaces beyond the range limit are not fused, so the ground truth leaves them out.
    """
    range_m = fusion_range_m(rig(config.street), config.fusion)
    return SyntheticSource(config.street, surface_range_m=min(range_m, FARTHEST_M))
