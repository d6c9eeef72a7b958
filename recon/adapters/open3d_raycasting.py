"""Open3D ray casting (Embree): which triangle does a ray meet first, and is a point in sight?"""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from recon.errors import ShapeError
from recon.structures.arrays import Bool, Float64, Int32

_NO_HIT = np.uint32(0xFFFFFFFF)


class RayScene:
    """A set of triangles that rays are cast at.

    Open3D works in single precision. It is asked for the triangle alone; whoever needs an exact
    distance intersects the ray with that triangle's plane in double precision.

    Args:
        triangles: (F, 3, 3) corners, metres.
        threads: Threads of a cast; 0 = one per core. The answer does not depend on it.

    Raises:
        ShapeError: There is no triangle, or a corner is not finite.
    """

    def __init__(self, triangles: NDArray[Any], threads: int = 0) -> None:
        corners = np.asarray(triangles)
        if corners.ndim != 3 or corners.shape[1:] != (3, 3) or not len(corners):
            raise ShapeError("triangles have the wrong shape", got=corners.shape, expected="F×3×3")
        if not np.isfinite(corners).all():
            raise ShapeError("a corner of a triangle is not finite")
        self._threads = threads
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = np.ascontiguousarray(corners.reshape(-1, 3), dtype=np.float32)
        faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(faces)
        )

    def first_hit(self, origin: Float64, directions: NDArray[Any]) -> Int32:
        """The first triangle on each ray.

        Args:
            origin: (3,), where all rays start.
            directions: (N, 3), any length but zero.

        Returns:
            int32 (N,), index of the triangle; -1 = the ray meets nothing.
        """
        hits = self._scene.cast_rays(_rays(origin, directions), nthreads=self._threads)
        faces = hits["primitive_ids"].numpy()
        return np.where(faces == _NO_HIT, -1, faces.astype(np.int64)).astype(np.int32)

    def blocked(
        self, origins: NDArray[Any], reaches: NDArray[Any], near: float = 0.0, far: float = 1.0
    ) -> Bool:
        """Whether anything stands on the segment from ``origin`` to ``origin + reach``.

        Args:
            origins: (3,) or (N, 3), metres.
            reaches: (N, 3), metres.
            near: Share of the reach at which the segment begins.
            far: Share of the reach at which it ends; below 1 spares the surface it ends on.

        Returns:
            bool (N,).
        """
        rays = _rays(origins, reaches)
        hit = self._scene.test_occlusions(rays, tnear=near, tfar=far, nthreads=self._threads)
        return np.asarray(hit.numpy(), dtype=np.bool_)


def _rays(origins: NDArray[Any], directions: NDArray[Any]) -> Any:
    """Open3D's (N, 6) single-precision rays."""
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3] = origins
    rays[:, 3:] = directions
    return o3d.core.Tensor.from_numpy(rays)
