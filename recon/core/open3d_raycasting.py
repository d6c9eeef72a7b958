"""Open3D's ray casting (Embree): first triangle hit by a ray, and visibility tests."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import ShapeError
from recon.core.lazy import Lazy
from recon.core.values.arrays import Bool, Float32, Float64, Int32

o3d = Lazy("open3d")

_NO_HIT = np.uint32(0xFFFFFFFF)


class RayScene:
    """Triangles (F, 3, 3) for ray casting in single precision; ``threads`` 0 = one per core."""

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

    def first_hit(self, origins: Float64, directions: NDArray[Any]) -> Int32:
        """Return int32 (N,): the first triangle on rays (N, 3) from (3,) or (N, 3); -1 = none."""
        hits = self._scene.cast_rays(_rays(origins, directions), nthreads=self._threads)
        faces = hits["primitive_ids"].numpy()
        return np.where(faces == _NO_HIT, -1, faces.astype(np.int64)).astype(np.int32)

    def reach(self, origins: Float64, directions: NDArray[Any]) -> Float32:
        """Return float32 (N,): times its direction, how far each ray goes; infinity = no hit."""
        hits = self._scene.cast_rays(_rays(origins, directions), nthreads=self._threads)
        return np.asarray(hits["t_hit"].numpy(), dtype=np.float32)

    def distance(self, points: NDArray[Any]) -> Float32:
        """Return distance of each point (N, 3) to the nearest triangle: float32 (N,), metres."""
        wanted = o3d.core.Tensor.from_numpy(np.array(points, dtype=np.float32))
        found = self._scene.compute_distance(wanted, nthreads=self._threads)
        return np.asarray(found.numpy(), dtype=np.float32)

    def blocked(self, origins: NDArray[Any], reaches: NDArray[Any], far: float = 1.0) -> Bool:
        """Return bool (N,), whether segments from (3,) or (N, 3) to part of their reaches hit."""
        rays = _rays(origins, reaches)
        hit = self._scene.test_occlusions(rays, tfar=far, nthreads=self._threads)
        return np.asarray(hit.numpy(), dtype=np.bool_)


def _rays(origins: NDArray[Any], directions: NDArray[Any]) -> Any:
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3] = origins
    rays[:, 3:] = directions
    return o3d.core.Tensor.from_numpy(rays)
