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
from collections.abc import Iterable
from typing import Final

import cv2
import numpy as np

from recon.core.geometry.se3 import apply, invert
from recon.core.kernels.voxels import pack_keys, unpack_keys
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
_CUBE: Final = 16  # voxels along a cube that is in view or not as a whole
_LESS: Final = 0.5
_SIGMAS: Final = 2.0
_PLAINEST: Final = 0.05  # fraction of the squares of an image
_PROBABILITIES: Final = MIN_PROBABILITY, MAX_PROBABILITY, HIT_PROBABILITY, MISS_PROBABILITY
_AROUND: Final = np.ones((3, 3), np.uint8)
GONE: Final = np.float32(0)
"""Log-odds of a voxel that left: exactly even, as no sum of what rays say is."""
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


def find_gone(voxels: OccupancyVoxels, views: Iterable[FrameView]) -> Bool:
    """Return bool (N,), the voxels that left, by the views of all frames near, in their order."""
    occupied = np.flatnonzero(voxels.log_odds > 0)  # some per cent: others cannot leave
    places, gone = voxels.centres_m[occupied], np.zeros(len(voxels), np.bool_)
    hits, texture_sum, state = np.zeros((3, len(places)))
    seen_from = np.ones_like(places)  # from where each was hit last, relative to it
    low, high, hit_more, missed = map(log_odds, _PROBABILITIES)
    cubes, cube = np.unique(pack_keys(voxels.keys[occupied] // _CUBE), return_inverse=True)
    size_m = _CUBE * voxels.resolution_m
    middles = size_m * (unpack_keys(cubes) + 0.5)
    for rays, T, camera in views:
        if not (rays.texture.size and len(rays)):
            continue
        near, far, before, texture, sigma = _seen_in(rays, camera)
        in_view = _in_view(apply(invert(T), middles), size_m, camera, rays.texture.shape)
        inside = np.flatnonzero(in_view[cube])
        ahead = apply(invert(T), places[inside])
        rows, cell = _squares(ahead, camera, rays.texture.shape)
        rows, inverse = inside[rows], 1 / ahead[rows, 2]
        off = _SIGMAS * sigma + voxels.resolution_m * inverse**2
        seen = (far[cell] - off <= inverse) & (inverse <= near[cell] + off)
        hit = rows[seen]
        hits[hit] += 1
        texture_sum[hit] += texture[cell[seen]]
        seen_from[hit] = T[:3, 3] - places[hit]
        state[hit] = np.minimum(state[hit] + hit_more, high)
        # Nothing is there or before it, and less texture than on average when it was hit.
        less = texture[cell] * hits[rows] <= _LESS * texture_sum[rows]
        rows = rows[less & ~seen & (hits[rows] > 0) & (before[cell] < inverse - off)]
        rows = rows[_alike(T[:3, 3] - places[rows], seen_from[rows])]
        state[rows] = np.maximum(state[rows] + missed, low)
    gone[occupied] = (hits > 0) & (state <= 0)
    return gone


def _alike(now: Float64, last: Float64) -> Bool:
    """Return which views of places (N, 3) from two sides show about the same of their surface."""
    length, before = np.linalg.norm(now, axis=1), np.linalg.norm(last, axis=1)
    as_far = np.abs(np.log(length / before)) <= math.log(_AS_FAR)
    return np.asarray(as_far & ((now * last).sum(axis=1) >= _AS_SEEN * length * before))


def _seen_in(
    rays: RayCloud, camera: RectifiedCamera
) -> tuple[Float64, Float64, Float64, Float64, float]:
    """Return what is in squares of an image (S,), and the standard deviation of inverse depths.

    Largest and smallest inverse depth, 1/m (−inf and inf where nothing is); the largest of what may
    hide it, in those around it and the next ones to both sides; and the texture around it.
    """
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
    texture = cv2.dilate(rays.texture, _AROUND).astype(np.float64)
    return near, far, before.ravel(), texture.ravel(), sigma


def _squares(xyz: Float64, camera: RectifiedCamera, shape: tuple[int, ...]) -> tuple[Int64, Int64]:
    """Return which points (N, 3), camera axes, are in the image, and the square of each of them."""
    ahead = np.flatnonzero(xyz[:, 2] > MIN_DEPTH_M)
    column, row = (
        np.floor((camera.focal_px * xyz[ahead, axis] / xyz[ahead, 2] + middle + 0.5) / CELL_PX)
        for axis, middle in enumerate((camera.cx_px, camera.cy_px))
    )
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return ahead[inside], (row * shape[1] + column)[inside].astype(np.int64)


def _in_view(
    middles: Float64, size_m: float, camera: RectifiedCamera, shape: tuple[int, ...]
) -> Bool:
    """Return which cubes, by their middles (N, 3) in camera axes, may reach into the image."""
    x, y, z = middles.T
    reach_m, focal = math.sqrt(3.0) / 2 * size_m, camera.focal_px
    inside = z > MIN_DEPTH_M - reach_m
    for across, centre, squares in ((x, camera.cx_px, shape[1]), (y, camera.cy_px, shape[0])):
        for sign, edge in ((1, centre + 0.5), (-1, centre + 0.5 - CELL_PX * squares)):
            # The plane through the camera and this side of the image.
            inside &= sign * (focal * across + edge * z) >= -reach_m * math.hypot(focal, edge)
    return np.asarray(inside)


def _last(values: Float64) -> Float64:
    """Return the last value in each row up to each place that is not −inf, which is left before."""
    place = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.take_along_axis(values, np.maximum.accumulate(place, axis=1), axis=1)
