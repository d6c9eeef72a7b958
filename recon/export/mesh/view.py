"""The surface of one stereo pair, computed in image coordinates: column, row and disparity.

In metres, an octree of equal cells is too coarse close by or too fine far away.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.open3d_raycasting import RayScene
from recon.core.values import PointCloud, RectifiedCamera, TriangleMesh
from recon.core.values.arrays import Bool, Float32
from recon.export.mesh.cut import vertex_normals
from recon.export.mesh.poisson import (
    MIN_DEPTH,
    OCTREE_SCALE,
    MeshSettings,
    Octree,
    oriented,
    trimmed_surface,
    usable,
    widest_cell,
)

# A point is covered if the mesh is no farther from it than this share of its depth.
COVERED_WITHIN: Final = 0.005
LEAST_COVERAGE: Final = 0.8  # share of the points of a pair that its mesh should cover
# Pixels that a pixel of disparity counts for: what is trimmed as farther than two pixel spacings
# from the points (2.8 pixels) is then a step of 1.4 pixels of disparity or more.
_DISPARITY_STEP: Final = 2.0
# Cells that the surface may cross, about: Poisson takes 20 s for so many. Images of more than a
# quarter of a megapixel get larger cells.
_MOST_CELLS: Final = 60_000
_COVERAGE_SAMPLES: Final = 100_000


def reconstruct_view(
    cloud: PointCloud, camera: RectifiedCamera, settings: MeshSettings
) -> TriangleMesh:
    """Reconstruct the surface that one stereo pair sees; spacings of ``settings`` are pixels here.

    Returns:
        The mesh in camera axes, as the cloud, with unit normals towards the camera, and colours if
        the cloud has any.

    Ref: Kazhdan & Hoppe, "Screened Poisson surface reconstruction", ACM TOG 32(3), 2013.
    """
    cloud = usable(cloud.select(cloud.xyz[:, 2] > 0))
    cloud = oriented(cloud, viewpoint_m=(0.0, 0.0, 0.0))
    seen = _in_image(cloud, camera)
    low, high = seen.xyz.min(axis=0), seen.xyz.max(axis=0)

    def outside(vertices: Float32) -> Bool:
        beside = ((vertices < low) | (vertices > high))[:, :2].any(axis=1)
        # As disparities approach zero, depths approach infinity.
        return np.asarray(beside | (vertices[:, 2] > high[2] / 2))

    mesh = trimmed_surface(seen, settings, _octree(seen.xyz, settings), outside)
    vertices = _in_metres(mesh.vertices, camera)
    return replace(mesh, vertices=vertices, normals=vertex_normals(vertices, mesh.faces))


def mesh_coverage(mesh: TriangleMesh, cloud: PointCloud) -> float:
    """Return the share of the points of a pair that are covered by its mesh, from 0 to 1.

    Of more than 100,000 points, every n-th is used.
    """
    xyz = cloud.xyz[:: math.ceil(len(cloud) / _COVERAGE_SAMPLES)]
    distance_m = RayScene(mesh.vertices[mesh.faces]).distance(xyz)
    return float(np.mean(distance_m <= COVERED_WITHIN * xyz[:, 2]))


def check_coverage(coverage: float) -> tuple[str, ...]:
    """Return a warning if the mesh of a pair leaves out much of its cloud."""
    if coverage >= LEAST_COVERAGE:
        return ()
    tolerance = f"points within {100 * COVERED_WITHIN:g} % of their depth"
    advice = "lower mesh.cell_spacings or mesh.min_component_faces, or use the cloud"
    return (f"the mesh covers {100 * coverage:.2g} % of the cloud ({tolerance}); {advice}",)


def _in_image(cloud: PointCloud, camera: RectifiedCamera) -> PointCloud:
    """Return a cloud in camera axes and its normals by column, row and negative disparity.

    From the principal point and infinity, in pixels. The mapping is projective, so planes stay
    planes, and it preserves orientation.
    """
    f, fb = camera.focal_px, _DISPARITY_STEP * camera.focal_px * camera.baseline_m
    x, y, z = cloud.xyz.T.astype(np.float64)
    xyz = np.stack([f * x / z, f * y / z, -fb / z], axis=1)
    # A normal is transformed by the transposed Jacobian of the way back to metres; its columns
    # are the motions of the point per pixel of each image coordinate.
    along = np.asarray(cloud.normals, np.float64)
    depthwards = np.einsum("ij,ij->i", along, cloud.xyz) / fb
    pulled = np.stack([along[:, 0] / f, along[:, 1] / f, depthwards], axis=1)
    pulled /= np.linalg.norm(pulled, axis=1, keepdims=True)
    return replace(cloud, xyz=xyz.astype(np.float32), normals=pulled.astype(np.float32))


def _in_metres(vertices: Float32, camera: RectifiedCamera) -> Float32:
    """Return float32 (V, 3): camera axes from image coordinates."""
    column, row, disparity = vertices.T.astype(np.float64)
    z = -(_DISPARITY_STEP * camera.focal_px * camera.baseline_m) / disparity
    xyz = np.stack([column * z / camera.focal_px, row * z / camera.focal_px, z], axis=1)
    return np.asarray(xyz, dtype=np.float32)


def _octree(xyz: Float32, settings: MeshSettings) -> Octree:
    """Return the octree whose cells are as wide as the settings allow, for an image of any size."""
    if settings.depth is not None:
        return Octree(settings.depth)
    extent = float(np.ptp(xyz, axis=0).max())
    # A spacing, the distance to the sixth neighbour, is the diagonal of the pixel of a point.
    cells = len(xyz) / (2 * settings.cell_spacings**2)
    cell = widest_cell(xyz, settings) * max(1.0, math.sqrt(cells / _MOST_CELLS))
    cell = max(cell, extent / 2**settings.max_depth)  # not 0 where points coincide
    depth = math.ceil(math.log2(OCTREE_SCALE * extent / cell))
    depth = min(max(depth, MIN_DEPTH), settings.max_depth)
    return Octree(depth, max(OCTREE_SCALE, cell * 2**depth / extent))
