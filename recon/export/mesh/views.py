"""What the images of drives show of places in the map, and how they were exposed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

from recon.core.geometry.se3 import apply, invert, rotate
from recon.core.open3d_raycasting import RayScene
from recon.core.values import RectifiedCamera, TriangleMesh
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.core.values.camera import project, unproject
from recon.core.values.image import in_colour
from recon.export.product import DriveImages

_STEP: Final = 2  # pixels between the rays that say how far an image sees
_SAMPLES: Final = 50_000  # most vertices that exposures are compared at
_DARK, _BRIGHT = 8, 247  # beyond, exposures cannot be compared
_ANCHOR: Final = 1e-3  # how much the fused points count beside an image


class PosedImage(NamedTuple):
    """A rectified image, and where it was taken."""

    number: int  # from 0
    image: UInt8  # (H, W, 3)
    camera: RectifiedCamera
    T_map_camera: Float64


Views = Callable[[], Iterable[PosedImage]]
"""Gives the same images again each time it is called, one in memory at a time."""


def posed_images(drives: Sequence[DriveImages]) -> Iterator[PosedImage]:
    """Yield the left images of all frames that have a place, numbered over all drives."""
    first = 0
    for drive in drives:
        for frame, images in drive.views():
            colours = in_colour(images[0])
            camera, T_map_camera = drive.session.camera, drive.T_map_camera[frame]
            yield PosedImage(first + frame, colours, camera, T_map_camera)
        first += len(drive.placed)


class Sight:
    """What an image shows of places in map axes, (N, 3), unless a surface is before them."""

    def __init__(self, view: PosedImage, scene: RayScene, edge_m: float) -> None:
        """``edge_m`` is how far a place may lie behind the surface."""
        self.view, self.eye, self._edge_m = view, view.T_map_camera[:3, 3], edge_m
        height, width = view.image.shape[:2]
        row, column = np.mgrid[0:height:_STEP, 0:width:_STEP]
        ahead = unproject(column.ravel(), row.ravel(), np.ones(row.size), view.camera)
        depth = scene.reach(self.eye, rotate(view.T_map_camera, ahead))
        # Of a plane, it is linear in the image.
        self._nearness = (1 / depth).reshape(row.shape)

    def project(self, xyz: Float32) -> Float32:
        """Return float32 (4, N): column, row, depth, pixels to the border (< 0 = not in it)."""
        there = apply(invert(self.view.T_map_camera), xyz)
        u, v, _ = project(there, self.view.camera)
        height, width = self.view.image.shape[:2]
        inside = np.minimum(np.minimum(u, width - 1 - u), np.minimum(v, height - 1 - v))
        found = np.nan_to_num(np.stack([u, v, there[:, 2], inside]), nan=-1.0)
        return np.asarray(found, np.float32)

    def look(self, xyz: Float32) -> tuple[Float32, Bool]:
        """Return float32 (N, 3), the colours there; and bool (N,), which places are seen."""
        u, v, depth, inside = self.project(xyz)
        nearness = sampled(self._nearness, u / _STEP, v / _STEP)
        seen = (inside >= 0) & ((depth - self._edge_m) * nearness <= 1)
        return sampled(self.view.image, u, v), seen


def sampled(image: NDArray[Any], u: NDArray[Any], v: NDArray[Any]) -> Float32:
    """Return float32 (N, …), the values of an image at columns and rows (N,), interpolated."""
    width = 1 << 14  # OpenCV takes no longer rows
    where = np.zeros((2, (1 + len(u) // width) * width), np.float32)
    where[:, : len(u)] = u, v
    column, row = where.reshape(2, -1, width)
    found = cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found.reshape(-1, *image.shape[2:])[: len(u)], np.float32)


class Exposures:
    """How bright images are at vertices that several of them see.

    Attributes:
        footprint_m: float32 (S,), width of the smallest pixel that sees each; infinity = none.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        chosen = slice(None, None, -(-len(mesh.vertices) // _SAMPLES))
        self._xyz = mesh.vertices[chosen]
        self._fused = None if mesh.rgb is None else mesh.rgb[chosen].mean(axis=1)
        self.footprint_m = np.full(len(self._xyz), np.inf, np.float32)
        self._looks: list[Float64] = []  # (3, N): vertices, images, logarithms of grey levels

    def add(self, sight: Sight) -> None:
        """Compare an image with those before."""
        rgb, seen = sight.look(self._xyz)
        away_m = np.linalg.norm(self._xyz - sight.eye, axis=1)
        pixel_m = np.where(seen, away_m / sight.view.camera.focal_px, np.inf)
        self.footprint_m = np.minimum(self.footprint_m, pixel_m)
        self._look(sight.view.number, rgb.mean(axis=1), seen)

    def _look(self, image: int, grey: NDArray[Any], seen: Bool) -> None:
        rows = np.flatnonzero(seen & (grey > _DARK) & (grey < _BRIGHT))
        self._looks.append(np.stack([rows, np.full(len(rows), image), np.log(grey[rows])]))

    def evened(self, count: int) -> tuple[Float64, float]:
        """Return float64 (count,), factors that make images equally bright; and what is left.

        The squared differences of logarithms from their mean at each vertex are least. The colours
        of vertices are one more image, that of factor 1: it counts as little as to keep the others
        from drifting along a drive. What is left is the median difference from these, grey levels.
        """
        if self._fused is not None:
            self._look(count, self._fused, np.ones(len(self._fused), np.bool_))
        place, image, level = np.concatenate(self._looks, axis=1)
        place, image = place.astype(np.int64), image.astype(np.int64)
        weight = np.where(image == count, _ANCHOR, 1.0)
        seen = csr_array((weight, (place, image)), (len(self._xyz), count + 1))
        total = np.maximum(seen.sum(axis=1), _ANCHOR)
        mean = np.bincount(place, weight * level, len(total)) / total
        # An image that shares nothing with others keeps its brightness.
        matrix = diags_array(seen.sum(axis=0) + _ANCHOR) - seen.T @ diags_array(1 / total) @ seen
        right = seen.T @ mean - np.bincount(image, weight * level, count + 1)
        gains = spsolve(matrix.tocsc(), right)
        gains = np.exp(gains - gains[count])
        if self._fused is None:
            return gains[:count], np.inf
        off = np.abs(gains[image] * np.exp(level) - self._fused[place])[image < count]
        return gains[:count], float(np.median(off))
