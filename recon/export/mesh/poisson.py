"""The surface of a cloud: by screened Poisson reconstruction, or through the voxels of a map.

Both are trimmed to where there is data; decision 0036.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final, Literal

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.errors import MeshingError
from recon.core.settings import Length, Settings
from recon.core.text import counted
from recon.core.values import PointCloud, TriangleMesh
from recon.core.values.arrays import Bool, Float32, Int32
from recon.export.mesh.cut import drop_small_components, keep_vertices, vertex_normals
from recon.export.pymeshlab import screened_poisson
from recon.io.models.mesh import decimate
from recon.map.kernels.distance import surface_of
from recon.stereo import open3d_clouds

OVERLAP_M: Final = 3.0
"""Margin, on a road, around a tile whose points its surface is fitted to as well. A tile is at
least as wide as both margins together: else every point would be meshed more than four times."""
_MIN_POINTS = 50
_MIN_DEPTH = 4
_FARTHEST = 1000.0  # distance of a point from the middle, as a multiple of their median
_SPACING_NEIGHBOURS = 7
_SPACING_SAMPLES = 20_000
_OCTREE_SCALE = 1.1  # MeshLab's octree is this much wider than the cloud
POINT_WEIGHT: Final = 4.0  # of the points against their normals, of clouds with noise
_LEAST_SUPPORTED: Final = 0.01  # of the vertices, which are cut off: bulges beyond the points
_CELL_SPACINGS: Final = 1.5  # widest octree cell: noise becomes ripples in smaller ones
_MAX_DEPTH: Final = 10  # that is chosen by the points: bounds time and memory
Point = tuple[float, float, float]
_NORMALS_NEIGHBOURS: Final = 20  # neighbours for normals where the cloud has none


class MeshSettings(Settings):
    """How a surface is reconstructed and trimmed."""

    surface: Literal["grid", "poisson"] = "grid"
    """How the surface is made: from a grid, that of the pixels of a pair or that of the voxels of a
    map, in seconds; or by MeshLab's Poisson reconstruction, which closes wider holes and is
    smoother."""
    pair_solid_m: float | None = Field(None, gt=0, le=100_000.0)
    """Thickness of the surface of a pair, in metres behind it, as a closed body for printing; none
    = an open surface."""
    depth: int | None = Field(None, ge=4, le=12)
    """Octree depth of Poisson's; none = by the spacing of the points, at most 10. Each step halves
    the cells, and takes four times the memory."""
    max_distance_spacings: float | None = Field(2.0, ge=0.01, le=1000000.0)
    """Farthest a vertex may lie from the points, in local point spacings; none = keep all. Lower it
    to keep holes open."""
    min_component_faces: int = Field(100, ge=1, le=1_000_000_000)
    """Connected pieces with fewer faces, over all tiles (with target_faces in each), are dropped.
    Raise it against crumbs."""
    target_faces: int | None = Field(None, ge=4, le=1_000_000_000)
    """Simplify to about so many faces; none = do not. For viewers and other programs with a limit.
    """
    tile_m: float = Length(50.0, ge=1e-06, le=100_000.0)
    """Edge of the tiles in which the map of a drive is meshed. Smaller ones take less memory."""
    texture_px: int = Field(8192, ge=64, le=16384)
    """Largest width and height of the picture of a textured map: what graphics cards take. Its
    texels are 0.7 times as wide as the pixels that saw the surface, wider where that is more."""

    @model_validator(mode="after")
    def _check_solid(self) -> Self:
        if self.pair_solid_m is not None:
            if self.surface != "grid":
                raise ValueError("pair_solid_m: only a surface with surface=grid is closed")
            if self.target_faces is not None:
                raise ValueError("pair_solid_m: a simplified surface has gaps; no target_faces")
        return self


def reconstruct_mesh(
    cloud: PointCloud,
    settings: MeshSettings,
    viewpoint_m: Point | None = None,
    wrong: Callable[[Float32], Bool] | None = None,
    point_weight: float = POINT_WEIGHT,
) -> TriangleMesh:
    """Reconstruct the surface that a cloud was sampled from.

    A Poisson surface is closed: it bridges every gap with a bulge. Parts that are farther from
    the points than the point spacing, or weakly supported, are removed, so that holes in the
    data stay holes in the mesh.

    Args:
        cloud: Points, with normals if possible; vertices take their colours.
        settings: Settings of the reconstruction.
        viewpoint_m: Where the points were seen from, if they have no normals; None = they are only
            made consistent, and may all be flipped.
        wrong: Returns which vertices (V, 3) cannot be on a surface; None = unknown.
        point_weight: Weight of the points against their normals; lower is smoother.

    Returns:
        The mesh, with outward unit normals, and colours if the cloud has any.

    Raises:
        MeshingError: The points are too few, coincident or collinear, or no face is left.

    Ref: Kazhdan & Hoppe, "Screened Poisson surface reconstruction", ACM TOG 32(3), 2013.
    """
    cloud = oriented(cloud, viewpoint_m)
    depth = settings.depth or _fitting_depth(cloud.xyz)
    normals = np.asarray(cloud.normals)
    vertices, faces, density = screened_poisson(
        cloud.xyz, normals, depth, _OCTREE_SCALE, point_weight
    )
    supported = density >= np.quantile(density, _LEAST_SUPPORTED)
    if settings.max_distance_spacings is not None:
        index, distance_m = open3d_clouds.nearest(vertices, cloud.xyz)
        near, where = np.unique(index[:, 0], return_inverse=True)
        local_m = _spacing(cloud.xyz[near], cloud.xyz)
        # A lone point is far from its neighbours, and must not support a large patch of surface.
        local_m = np.minimum(local_m, 2 * np.median(local_m))
        supported &= distance_m[:, 0] <= settings.max_distance_spacings * local_m[where]
    return trimmed(keep_vertices(vertices, faces, supported), cloud, settings, wrong)


def trimmed(
    surface: tuple[Float32, Int32],
    cloud: PointCloud,
    settings: MeshSettings,
    wrong: Callable[[Float32], Bool] | None,
) -> TriangleMesh:
    """Return the part of a surface that can be, without crumbs, in the colours of a cloud."""
    vertices, faces = surface
    if wrong is not None:
        vertices, faces = keep_vertices(vertices, faces, ~wrong(vertices))
    vertices, faces = drop_small_components(vertices, faces, settings.min_component_faces)
    rgb = None if cloud.rgb is None else cloud.rgb[_nearest(vertices, cloud.xyz)]
    mesh = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)
    return simplified(mesh, settings)


def simplified(mesh: TriangleMesh, settings: MeshSettings) -> TriangleMesh:
    """Return a mesh with about as many faces as the settings allow, if it has more."""
    if settings.target_faces is None or len(mesh.faces) <= settings.target_faces:
        return mesh
    vertices, faces = decimate(mesh.vertices, mesh.faces, settings.target_faces)
    rgb = None if mesh.rgb is None else mesh.rgb[_nearest(vertices, mesh.vertices)]
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)


def _nearest(some_xyz: Float32, xyz: Float32) -> Int32:
    return open3d_clouds.nearest(some_xyz, xyz)[0][:, 0]


def usable(cloud: PointCloud) -> PointCloud:
    """Return the finite points of a cloud, if they can span a surface."""
    finite = np.asarray(np.isfinite(cloud.xyz).all(axis=1))
    if finite.sum() < _MIN_POINTS:
        expected = f"at least {_MIN_POINTS} finite points"
        raise MeshingError("too few points for a surface", got=int(finite.sum()), expected=expected)
    cloud = cloud.select(finite)
    # An octree would have the points of a cloud in one cell whose box is much wider.
    away_m = np.linalg.norm(cloud.xyz.astype(np.float64) - np.median(cloud.xyz, axis=0), axis=1)
    half_m, farthest_m = float(np.median(away_m)), float(away_m.max())
    if farthest_m > _FARTHEST * half_m > 0:
        half = f"of which half of the points are within {half_m:.3g} m"
        got, hint = f"{farthest_m:.3g} m from the middle, {half}", "remove outliers from the cloud"
        raise MeshingError("a point lies far from all others", got=got, hint=hint)
    centred = cloud.xyz.astype(np.float64) - cloud.xyz.mean(axis=0, dtype=np.float64)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred / len(centred)), 0))
    # float32 coordinates resolve about 1e-5 of the extent.
    farthest = float(np.abs(cloud.xyz).max())
    if spread[1] <= 1e-5 * max(spread[2], farthest):
        distant = spread[1] > 1e-5 * spread[2] and spread[1] > 0
        got = f"{counted(len(cloud), 'point')}, up to {farthest:.3g} m from the origin"
        way_on = "subtract an offset from all coordinates" if distant else None
        raise MeshingError("all points lie in one place or on one line", got=got, hint=way_on)
    return cloud


def oriented(cloud: PointCloud, viewpoint_m: Point | None = None) -> PointCloud:
    """Return the usable points that have a normal, or all of them with estimated normals."""
    cloud = usable(cloud)
    if cloud.normals is not None:
        # NaN fails the comparison, so it counts as no normal.
        known = np.asarray(np.linalg.norm(cloud.normals, axis=1) > 0.5)
        if known.sum() >= _MIN_POINTS:
            return cloud.select(known)
    normals = open3d_clouds.estimate_normals(cloud.xyz, _NORMALS_NEIGHBOURS)
    if viewpoint_m is None:
        normals = open3d_clouds.agree_normals(cloud.xyz, normals, _NORMALS_NEIGHBOURS)
    else:
        away = np.einsum("ij,ij->i", normals, np.asarray(viewpoint_m) - cloud.xyz) < 0
        normals = np.where(away[:, None], -normals, normals)
    return replace(cloud, normals=normals)


def _fitting_depth(xyz: Float32) -> int:
    """Return the smallest octree depth whose cells are no wider than they may be."""
    cell_m = _CELL_SPACINGS * typical_spacing_m(xyz)
    extent_m = float(np.ptp(xyz, axis=0).max()) * _OCTREE_SCALE
    if cell_m * 2**_MAX_DEPTH <= extent_m:
        return _MAX_DEPTH
    return int(np.clip(math.ceil(math.log2(extent_m / cell_m)), _MIN_DEPTH, _MAX_DEPTH))


def typical_spacing_m(xyz: Float32) -> float:
    """Return the median distance of the points of a cloud to their seventh neighbour."""
    step = max(1, len(xyz) // _SPACING_SAMPLES)
    return float(np.median(_spacing(xyz[::step], xyz)))


def _spacing(some_xyz: Float32, xyz: Float32) -> Float32:
    """Return float32 (N,): distance of points of a cloud to their seventh neighbour in it."""
    return open3d_clouds.nearest(some_xyz, xyz, _SPACING_NEIGHBOURS)[1][:, -1]


_OF_SEVENTH: Final = math.sqrt(math.pi / 7)
"""Edge of the square that a point has for itself, as a fraction of the way to its seventh
neighbour: a circle that wide holds seven."""


def reconstruct_map_surface(
    cloud: PointCloud,
    settings: MeshSettings,
    voxel_m: float,
    wrong: Callable[[Float32], Bool] | None = None,
) -> TriangleMesh:
    """Return the surface that the points of a map with voxels of ``voxel_m`` lie on.

    Cells are as wide as its voxels, or two, four … times where points are that far apart. They
    have the same places in all parts of a map, so that these meet. Otherwise as `reconstruct_mesh`.
    """
    cloud = oriented(cloud)
    apart = _OF_SEVENTH * typical_spacing_m(cloud.xyz) / voxel_m
    cell_m = voxel_m * 2 ** round(math.log2(max(apart, 1)))
    # In float32 the kernel would lose what a large coordinate leaves no digits for.
    origin = np.floor(cloud.xyz.min(axis=0) / cell_m).astype(np.float64)
    farthest = settings.max_distance_spacings or math.inf
    places, faces = surface_of(cloud.xyz / cell_m - origin, np.asarray(cloud.normals), farthest)
    vertices = ((places + origin) * cell_m).astype(np.float32)
    return trimmed((vertices, faces), cloud, settings, wrong)
