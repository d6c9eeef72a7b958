"""What left a place before a plain wall: it is not seen again, though a camera looked there.

A ray that passes a voxel frees it, but stereo sees no plain wall, so none passes where something
stood before one. What shows that it left is the image: where its surface was matched there was
texture, and now there is less than half of it, and no match. Two views of a surface from about as
far and from about the same side show about the same texture, so what stays is not taken for what
left, however seldom it is matched. One such look is worth one ray that passes: what was certain
needs nine of them after it was hit last. Then it is unknown, not free: nothing was measured there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import cv2
import numpy as np

from recon.core.geometry.se3 import apply, invert
from recon.core.values import OccupancyVoxels, RayCloud, RectifiedCamera
from recon.core.values.arrays import Bool, Float64, Int64, UInt8
from recon.core.values.grid import log_odds
from recon.map.builders import (
    HIT_PROBABILITY,
    MAX_PROBABILITY,
    MIN_PROBABILITY,
    MISS_PROBABILITY,
)
from recon.map.kernels.raycast import MIN_DEPTH_M

CELL_PX: Final = 8
"""Side of a square of an image, about a matching window, of which the texture is kept."""
_LEVELS: Final = 4  # steps of a kept texture for a grey level per pixel
_AS_FAR: Final = math.sqrt(2.0)
_AS_SEEN: Final = math.cos(math.radians(30.0))
"""Views from within this ratio of a distance and this angle are alike: the gradient of an image of
a surface then falls to 1/√2 · cos 30° = 0.61 at the most."""
_LESS: Final = 0.5
_SIGMAS: Final = 2.0
_PLAINEST: Final = 0.05  # fraction of the squares of an image
_AROUND: Final = np.ones((3, 3), np.uint8)
FrameView = tuple[RayCloud, Float64, RectifiedCamera]
"""Rays of a frame with its texture, ``T_map_camera``, and its camera."""


def texture_of(image: UInt8, valid: Bool | None) -> UInt8:
    """Return mean size of the horizontal gradient in squares of an image, 255 = not known."""
    size = image.shape[1] // CELL_PX, image.shape[0] // CELL_PX
    whole = np.s_[: size[1] * CELL_PX, : size[0] * CELL_PX]
    if 0 in size:
        return np.zeros((0, 0), np.uint8)
    gradient = np.abs(cv2.Sobel(image, cv2.CV_32F, 1, 0)) / 8
    mean = cv2.resize(gradient[whole], size, interpolation=cv2.INTER_AREA)
    found = np.clip(np.rint(_LEVELS * mean), 0, 254)
    if valid is not None:
        shown = cv2.resize(valid[whole].astype(np.float32), size, interpolation=cv2.INTER_AREA)
        found[shown < 1] = 255
    return np.asarray(found, np.uint8)


def find_gone(voxels: OccupancyVoxels, views: Iterator[FrameView]) -> Bool:
    """Return bool (N,), the voxels that left, by the views of all frames near, in their order."""
    looks = _Looks(voxels.centres_m, voxels.resolution_m)
    for view in views:
        if view[0].texture.size and len(view[0]):
            looks.add(*view)
    return looks.gone


class _Looks:
    """What frames saw of places (N, 3), of which each may have a surface."""

    def __init__(self, places_m: Float64, resolution_m: float) -> None:
        self._places, self._resolution_m = places_m, resolution_m
        self._hits, self._texture = np.zeros((2, len(places_m)))
        self._from = np.ones_like(places_m)  # from where each was hit last, relative to it
        self._log_odds = np.zeros(len(places_m))

    @property
    def gone(self) -> Bool:
        return np.asarray((self._hits > 0) & (self._log_odds <= 0))

    def add(self, rays: RayCloud, T_map_camera: Float64, camera: RectifiedCamera) -> None:
        """Add a frame, of which there are rays and texture."""
        view = _seen_in(rays, camera)
        ahead = apply(invert(T_map_camera), self._places)
        rows, cell = _squares(ahead, camera, rays.texture.shape)
        inverse = 1 / ahead[rows, 2]
        off = _SIGMAS * view.sigma + self._resolution_m * inverse**2
        seen = (view.far[cell] - off <= inverse) & (inverse <= view.near[cell] + off)
        hit, texture = rows[seen], view.texture[cell]
        self._hits[hit] += 1
        self._texture[hit] += texture[seen]
        self._from[hit] = T_map_camera[:3, 3] - self._places[hit]
        self._change(hit, HIT_PROBABILITY)
        # Nothing is there or before it, and less texture than on average when it was hit.
        less = texture * self._hits[rows] <= _LESS * self._texture[rows]
        less &= ~seen & (self._hits[rows] > 0) & (view.before[cell] < inverse - off)
        rows = rows[less]
        now, last = T_map_camera[:3, 3] - self._places[rows], self._from[rows]
        length, before = np.linalg.norm(now, axis=1), np.linalg.norm(last, axis=1)
        alike = np.abs(np.log(length / before)) <= math.log(_AS_FAR)
        alike &= (now * last).sum(axis=1) >= _AS_SEEN * length * before
        self._change(rows[alike], MISS_PROBABILITY)

    def _change(self, rows: Int64, probability: float) -> None:
        low, high = log_odds(MIN_PROBABILITY), log_odds(MAX_PROBABILITY)
        self._log_odds[rows] = np.clip(self._log_odds[rows] + log_odds(probability), low, high)


class _Seen(NamedTuple):
    """Inverse depths, 1/m, that a frame saw in squares of its image (S,)."""

    near: Float64  # largest, −inf where nothing was seen
    far: Float64  # smallest, inf where nothing was seen
    # Largest of what may hide the square: in those around it, and in the next ones with something
    # on either side
    before: Float64
    sigma: float  # standard deviation
    texture: Float64  # most in those around it: what a window of the matcher may have seen


def _seen_in(rays: RayCloud, camera: RectifiedCamera) -> _Seen:
    xyz, shape = rays.cloud().xyz.astype(np.float64), rays.texture.shape
    rows, cell = _squares(xyz, camera, shape)
    inverse = 1 / xyz[rows, 2]
    near, far = np.full(rays.texture.size, -np.inf), np.full(rays.texture.size, np.inf)
    np.maximum.at(near, cell, inverse)
    np.minimum.at(far, cell, inverse)
    # What is matched in squares as plain as the plainest of an image is often noise.
    plain = rays.texture <= np.quantile(rays.texture, _PLAINEST) / _LESS
    image = np.where(plain, -np.inf, near.reshape(shape))
    beside = np.maximum(_last(image), _last(image[:, ::-1])[:, ::-1])
    before = np.maximum(cv2.dilate(image, _AROUND), beside)
    sigma = float(np.median(rays.sigma_m[rows] * inverse**2)) if len(rows) else 0.0
    texture = cv2.dilate(rays.texture, _AROUND).ravel().astype(np.float64)
    return _Seen(near, far, before.ravel(), sigma, texture)


def _squares(xyz: Float64, camera: RectifiedCamera, shape: tuple[int, ...]) -> tuple[Int64, Int64]:
    """Return which points (N, 3), camera axes, are in the image, and the square of each of them."""
    ahead = np.flatnonzero(xyz[:, 2] > MIN_DEPTH_M)
    column, row = (
        np.floor((camera.focal_px * xyz[ahead, axis] / xyz[ahead, 2] + middle + 0.5) / CELL_PX)
        for axis, middle in enumerate((camera.cx_px, camera.cy_px))
    )
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return ahead[inside], (row * shape[1] + column)[inside].astype(np.int64)


def _last(values: Float64) -> Float64:
    """Return the last value in each row up to each place that is not −inf, which is left before."""
    place = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.take_along_axis(values, np.maximum.accumulate(place, axis=1), axis=1)
