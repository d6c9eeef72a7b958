"""The rays of a frame, as a record of a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values import RayCloud, RayGrain
from recon.core.values.arrays import array_in, frozen_array
from recon.map.store.frames import FARTHEST_M
from recon.map.store.values import value_in

RAYS: Final = "rays"
RAY_BYTES: Final = 10
"""Of one ray in a record; a frame has at most one for each pixel."""


def rays_record(rays: RayCloud, grain: RayGrain) -> dict[str, Any]:
    """Return rays as a tree of arrays and plain values."""
    return {
        # Of neighbours in the image: small numbers, which compress.
        "steps": _zigzag(np.diff(rays.places, axis=0, prepend=np.zeros((1, 3), np.int16))),
        "sigma_m": rays.sigma_m,
        "confidence": rays.confidence,
        "count": rays.count,
        "grain": asdict(grain),
    }


def rays_in(content: Mapping[str, Any]) -> tuple[RayCloud, RayGrain]:
    """Return the rays in what `rays_record` gave."""
    grain = _checked(value_in(RayGrain, content["grain"]))
    steps = frozen_array("steps", content["steps"], np.uint16, (None, 3))
    places = np.cumsum(_unzigzag(steps), axis=0, dtype=np.int16)
    if array_in(content, "sigma_m", np.float16, (len(places),)).min(initial=0.0) < 0:
        raise FormatError("a ray of the map has a negative deviation")
    parts = {name: content[name] for name in ("sigma_m", "confidence", "count")}
    return value_in(RayCloud, {"places": places, **parts, "unit_m": grain.unit_m}), grain


def _checked(grain: RayGrain) -> RayGrain:
    """Return the resolution of rays."""
    sizes_m = (grain.cell_m, grain.unit_m, grain.max_range_m)
    ordered = 0 < min(sizes_m) <= max(sizes_m) <= grain.max_range_m <= FARTHEST_M
    if not (ordered and np.isfinite(sizes_m).all()):
        raise FormatError("sizes of the rays are impossible", got=sizes_m)
    return grain


def _zigzag(steps: NDArray[np.int16]) -> NDArray[np.uint16]:
    """Return steps of either sign as small positive numbers: 0, −1, 1, −2 become 0, 1, 2, 3."""
    return ((steps << 1) ^ (steps >> 15)).view(np.uint16)


def _unzigzag(codes: NDArray[np.uint16]) -> NDArray[np.int16]:
    return ((codes >> 1) ^ -(codes & 1)).view(np.int16)
