"""What is shown in 3-D of a pair or a map, as values that reports and the viewer draw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, transform_cloud
from recon.core.values import ATTRIBUTES, OccupancyGrid, PointCloud, TriangleMesh
from recon.core.values.arrays import Bool, Float64, UInt8
from recon.map.ground.surface import GroundSurface

# From camera axes (x right, y down, z forward) to x forward and z up.
T_UPRIGHT_CAMERA: Final[Float64] = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_SHOWN: Final = {each.view: each for each in ATTRIBUTES if each.view}
COLOURINGS: Final = ("image", "height", *(by for by in _SHOWN if by != "image"))
_SCALES: Final = {"turbo": "blue to red", "viridis": "blue to yellow"}  # others have no legend
_OUTLIER_FRACTION: Final = 0.002
# Candidate viewpoints: from behind (x is forward), from the sides, and from above.
_TURNS_RAD: Final = np.radians(np.arange(-75.0, 76.0, 15.0))
_ABOVE_RAD: Final = np.radians((25.0, 35.0, 50.0))
_CELLS: Final = np.array([48, 28])  # of the view, to count how much of it is filled
_TRIED_POINTS: Final = 4000
_CENTRED: Final = 4  # rounds of moving the look-at point to the middle of what is seen


@dataclass(frozen=True, eq=False)
class Points:
    """Points that belong together: a tile of a map, a submap, or where a camera was along a path.

    ``time_s`` and ``session`` of the ``cloud`` of a map are of the drive that came nearest.
    """

    name: str
    cloud: PointCloud

    def values(self, by: str) -> NDArray[Any] | None:
        """Return what a colouring shows, x or y: (N,), ``image``: (N, 3); None = unknown."""
        if by in _SHOWN:
            return self.cloud.arrays.get(_SHOWN[by].name)
        return self.cloud.xyz[:, {"x": 0, "y": 1}.get(by, 2)]


class Keyframes(Protocol):
    """The keyframes of a map, and what they saw."""

    @property
    def T_map_camera(self) -> Sequence[Float64]: ...

    points: Mapping[str, Float64]  # control points that can be clicked in them, by name each (3,)

    def mark(self, name: str, number: int, ray: Float64, depth_m: float) -> list[str]:
        """Return what a click (2, 3) at a control point, in an image at a depth, says of it."""
        ...

    def outline(self, number: int, depth_m: float) -> Float64:
        """Return line segments (N, 2, 3) around what a keyframe has in view up to a depth."""
        ...

    def sees(self, number: int, place_m: Float64) -> bool:
        """Return whether a keyframe has a place (3,) in view, with nothing before it."""
        ...

    def look(self, number: int) -> tuple[list[str], UInt8 | None]:
        """Return what is said of a keyframe, and a picture of it, uint8 (H, W, 3), or None."""
        ...


@dataclass(frozen=True, eq=False)
class Scene:
    """What is shown in 3-D, all in one frame, whose x is forward and whose z is up.

    Attributes:
        points: Parts of a cloud.
        mesh: Its surface.
        paths: Where cameras were, in order; ``rgb``: if a pose is trusted, or which path it is.
        grids: Occupancy seen from above, each with its ground; reports have figures of them.
        keyframes: Of the viewer, which asks them.
        lines: What the viewer says of the run.
        spacing_m: Between points.
        eye_m: From where it is seen at first; None = from where all is in view.
    """

    points: tuple[Points, ...] = ()
    mesh: TriangleMesh | None = None
    paths: tuple[Points, ...] = ()
    grids: tuple[tuple[OccupancyGrid, GroundSurface], ...] = ()
    keyframes: Keyframes | None = None
    lines: Sequence[str] = ()
    spacing_m: float = 0.1
    eye_m: tuple[float, float, float] | None = None

    @property
    def empty(self) -> bool:
        """Whether there is neither a point nor a triangle."""
        points = any(len(part.cloud) for part in self.points)
        return not points and (self.mesh is None or not len(self.mesh.faces))


def upright_scene(
    cloud: PointCloud | None,
    mesh: TriangleMesh | None = None,
    eye_m: tuple[float, float, float] | None = None,
) -> Scene:
    """Return the scene of what is in the axes of a camera; ``eye_m`` is in those of the scene."""
    points: tuple[Points, ...] = ()
    if cloud is not None:
        points = (Points("cloud", transform_cloud(cloud, T_UPRIGHT_CAMERA, frame="map")),)
    if mesh is not None:
        vertices = apply(T_UPRIGHT_CAMERA, mesh.vertices).astype(np.float32)
        mesh = TriangleMesh(vertices, mesh.faces, rgb=mesh.rgb)
    return Scene(points, mesh, eye_m=eye_m)


def known_colourings(parts: Sequence[Points]) -> list[str]:
    """Return by what points can be coloured, which all parts know."""
    return [by for by in COLOURINGS if all(part.values(by) is not None for part in parts)]


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


def near_others(xyz: NDArray[Any]) -> Bool:
    """Return (N,): False for the few points far from all others, which would shrink the rest."""
    if not len(xyz):
        return np.zeros(0, np.bool_)
    low, high = np.quantile(xyz, (_OUTLIER_FRACTION, 1.0 - _OUTLIER_FRACTION), axis=0)
    room = 0.1 * (high - low)
    return np.asarray(((xyz >= low - room) & (xyz <= high + room)).all(axis=1))


def first_view(xyz: NDArray[Any], half_view: tuple[float, float]) -> tuple[Float64, Float64]:
    """Return eye and look-at point (3,) from which all points (N, 3) are in view, and fill it.

    ``half_view``: tangents of half of the view, across and up.
    """
    if not len(xyz):
        return np.array([-1.0, 0.0, 0.5]), np.zeros(3)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    middle, scale = (low + high) / 2.0, max(float((high - low).max()) / 2.0, 0.01)
    some = (xyz[:: max(1, len(xyz) // _TRIED_POINTS)] - middle) / scale
    tried = [
        _view_from(some, turn, above, np.array(half_view))
        for turn in _TURNS_RAD
        for above in _ABOVE_RAD
    ]
    _, eye, look_at = max(tried, key=lambda view: view[0])
    return middle + scale * eye, middle + scale * look_at


def _view_from(
    points: Float64, turn_rad: float, above_rad: float, half_view: Float64
) -> tuple[int, Float64, Float64]:
    """Return the nearest view of all points from one direction: filled cells, eye, look-at."""
    level = -np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    towards = np.cos(above_rad) * level + [0.0, 0.0, np.sin(above_rad)]
    across = np.array([-level[1], level[0], 0.0])
    axes = np.stack([across, np.cross(towards, across)])
    look_at, place, away = np.zeros(3), np.zeros((1, 2)), 0.0
    for _ in range(_CENTRED):
        flat, near = (points - look_at) @ axes.T, (points - look_at) @ towards
        # A point at distance z before the eye is in view up to z times the tangent of half of it.
        away = max(float((np.abs(flat) / half_view + near[:, None]).max()), 0.1)
        place = flat / (away - near)[:, None]
        look_at = look_at + away * (place.max(axis=0) + place.min(axis=0)) / 2 @ axes
    cells = np.floor((place / half_view + 1) / 2 * _CELLS)
    # Not to be moved after the last measurement of what is in view.
    centre = look_at - away * (place.max(axis=0) + place.min(axis=0)) / 2 @ axes
    return len(np.unique(cells @ [1, 1j])), centre + away * towards, centre


def thin_cloud(cloud: PointCloud, limit: int) -> PointCloud:
    """Return at most ``limit`` points, evenly spread: the first of each cell of a coarse grid."""
    kept = np.arange(len(cloud))
    longest_m = float(np.ptp(cloud.xyz, axis=0).max()) if len(cloud) else 0.0
    # At first more than ``limit`` cells on a face of the bounding cube.
    cell_m = max(longest_m / (4.0 * math.sqrt(limit)), 1e-6)
    while len(kept) > limit:
        kept = np.sort(np.unique(_cell_numbers(cloud.xyz, cell_m), return_index=True)[1])
        cell_m *= max(math.sqrt(len(kept) / limit), 1.02)
    return cloud.select(kept)


def thin_mesh(mesh: TriangleMesh, limit: int) -> TriangleMesh:
    """Return at most about ``limit`` triangles for display, by merging vertices in cells."""
    # Open3D's quadric decimation takes nine times as long, and drops the colours.
    if len(mesh.faces) <= limit:
        return mesh
    cell_m, thinned, edge_m = 0.0, mesh, _typical_edge_m(mesh)
    while len(thinned.faces) > limit:
        # The number of triangles falls with the square of the cell size.
        cell_m = max(cell_m * math.sqrt(len(thinned.faces) / limit) * 1.05, edge_m)
        thinned = _merge_vertices(mesh, cell_m)
    return thinned


def _cell_numbers(xyz: NDArray[Any], cell_m: float) -> NDArray[np.int64]:
    cells = np.floor((xyz - xyz.min(axis=0)) / cell_m).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)))


def _merge_vertices(mesh: TriangleMesh, cell_m: float) -> TriangleMesh:
    numbers = _cell_numbers(mesh.vertices, cell_m)
    _, first, cell = np.unique(numbers, return_index=True, return_inverse=True)
    faces = cell.reshape(-1)[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    rgb = None if mesh.rgb is None else mesh.rgb[first]
    return TriangleMesh(mesh.vertices[first], faces[(a != b) & (b != c) & (c != a)], rgb=rgb)


def _typical_edge_m(mesh: TriangleMesh) -> float:
    first, second = mesh.vertices[mesh.faces[:, :2]].swapaxes(0, 1)
    edge_m = float(np.median(np.linalg.norm(first - second, axis=1)))
    # At most 1e5 cells per side, so that cell numbers fit in an int64.
    return max(edge_m, float(np.ptp(mesh.vertices, axis=0).max()) * 1e-5, 1e-6)
