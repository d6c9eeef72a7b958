"""What is shown of a map, as values: which of its points, and in what colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values import ATTRIBUTES, OccupancyGrid, PointCloud, TriangleMesh
from recon.core.values.arrays import Float64, UInt8

if TYPE_CHECKING:
    from recon.view.follow import KeyframeViews

HOST: Final = "127.0.0.1"  # whoever looks is on this machine
MOST_POINTS: Final = 1_500_000  # in the browser: about 25 MB
_TILE_VOXELS: Final = 256  # edge of what is thinned together
_SHOWN: Final = {each.view: each for each in ATTRIBUTES if each.view}
COLOURINGS: Final = ("image", "height", *(by for by in _SHOWN if by != "image"))
_SCALES: Final = {"turbo": "blue to red", "viridis": "blue to yellow"}  # others have no legend
_CLICK_RAD: Final = 0.006  # about five pixels of a screen


@dataclass(frozen=True, eq=False)
class Points:
    """Points that are thinned together: a tile of a map, or a submap of one that grows.

    ``time_s`` and ``session`` of its ``cloud`` are of the drive that came nearest.
    """

    name: str
    cloud: PointCloud

    def values(self, by: str) -> NDArray[Any] | None:
        """Return what a colouring shows: (N,), or colours (N, 3) by ``image``; None = unknown."""
        if by in _SHOWN:
            return self.cloud.arrays.get(_SHOWN[by].name)
        return self.cloud.xyz[:, 2]


@dataclass(frozen=True, eq=False)
class Scene:
    """What is shown of a run: figures, points, grids and their heights, paths coloured by trust."""

    lines: Sequence[str]
    points: tuple[Points, ...] = ()
    spacing_m: float = 0.1
    grids: tuple[tuple[OccupancyGrid, float], ...] = ()
    mesh: TriangleMesh | None = None
    paths: tuple[Points, ...] = ()
    keyframes: KeyframeViews | None = None


def cut(cloud: PointCloud, spacing_m: float) -> tuple[Points, ...]:
    """Cut a cloud into square tiles, seen from above."""
    keys = (cloud.xyz[:, :2] // (_TILE_VOXELS * spacing_m)).astype(np.int64) @ [1 << 32, 1]
    order = np.argsort(keys, kind="stable")
    tiles = np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)
    return tuple(Points(f"{keys[own[0]]}", cloud.select(own)) for own in tiles if len(own))


def halvings(parts: Sequence[Points], eye_m: Float64, limit: int = MOST_POINTS) -> list[int]:
    """Return how often to halve each part to keep ``limit``: two more at twice the distance."""
    sizes = np.array([len(part.cloud) for part in parts])
    places = np.array([part.cloud.xyz[len(part.cloud) // 2] for part in parts])
    distance_m = np.maximum(np.linalg.norm(places - eye_m, axis=1), 1e-3)
    whole_m, times = float(distance_m.max()), np.zeros(len(parts), np.int64)
    while (-(-sizes >> times)).sum() > max(limit, len(parts)):  # rounded up
        whole_m /= np.sqrt(2.0)
        times = np.ceil(2.0 * np.log2(np.maximum(distance_m / whole_m, 1.0))).astype(np.int64)
    return [int(number) for number in times]


def colours(parts: Sequence[Points], by: str) -> tuple[list[UInt8], str]:
    """Return uint8 (N, 3) of each part, which all know what they are coloured by, and a legend."""
    values = [found for part in parts if (found := part.values(by)) is not None]
    scale, unit = (_SHOWN[by].scale, _SHOWN[by].unit) if by in _SHOWN else ("turbo", "m")
    if not (scale and values):
        return values, ""
    from recon.report.style import colour_values, value_range  # noqa: PLC0415 - takes a second

    if scale not in _SCALES:
        return [colour_values(each % 10, scale, (0.0, 9.0)) for each in values], ""
    ends = value_range(np.concatenate(values))
    legend = f"{ends[0]:.3g} to {ends[1]:.3g} {unit}, {_SCALES[scale]}"
    return [colour_values(each, scale, ends) for each in values], legend


def pick(parts: Sequence[Points], origin_m: Float64, direction: Float64) -> Float64 | None:
    """Return the nearest point (3,) that a ray passes close by; None where there is none."""
    best_m, best = np.inf, None
    for part in parts:
        xyz = part.cloud.xyz - origin_m
        along_m = xyz @ direction
        aside_m = np.linalg.norm(xyz - along_m[:, None] * direction, axis=1)
        along_m[aside_m > _CLICK_RAD * along_m] = np.inf
        if along_m.min() < best_m:
            best_m, best = along_m.min(), part.cloud.xyz[along_m.argmin()].astype(np.float64)
    return best


def first_view(scene: Scene) -> tuple[Float64, Float64]:
    """Return eye and look-at point (3,) from which most points are in view, from behind."""
    xyz = np.concatenate([part.cloud.xyz[::16] for part in scene.points])
    low, high = np.quantile(xyz, (0.05, 0.95), axis=0)
    away_m = max(float(np.linalg.norm(high - low)), 1e-3) * np.array([-0.75, -0.35, 0.55])
    return (low + high) / 2 + away_m, (low + high) / 2
