"""Keyframes for place recognition: features with disparity, and coarse disparities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import ShapeError
from recon.core.kernels.voxels import distinct_keys
from recon.core.values import Disparity, Rectified, RectifiedCamera
from recon.core.values.arrays import Float32, Float64, UInt8, freeze
from recon.core.values.camera import depth_from_disparity, unproject
from recon.odometry.features import values_around

_DESCRIPTOR_BYTES: Final = 32
FEATURES: Final = 600  # features of a keyframe
_CELL_PX: Final = 48  # edge of the cells that features are spread over
_SIZE_PX: Final = 300.0
"""Edge of a square with as many pixels as the image in which features are sought, at most; SIFT
doubles it. Smaller details cost more time, and are not seen again from farther away."""

_SIGMA_PX: Final = 0.5  # standard deviation of a feature's column or row in that image
_DOUBLED_PX: Final = 0.25  # by how much OpenCV places features of SIFT too far right and down
_CONTRAST: Final = 0.015  # least contrast of a feature
_MIN_DISPARITY_PX: Final = 1.0  # features with less disparity have no usable depth
_MAX_DISPARITY_STEP_PX: Final = 1.0  # largest difference between a disparity and its neighbours
_COARSE_PX: Final = 8  # every n-th disparity of a row and column is kept
WORDS: Final = 4  # words per descriptor (hash tables)
_BITS: Final = 20  # bits of a descriptor per word


@dataclass(frozen=True, eq=False)
class Keyframe:
    """What is kept of a frame to recognise its place."""

    frame: int  # number of the frame in the drive
    # float32 (N, 3), column, row and disparity of each feature; disparity NaN = unknown
    uvd: Float32
    descriptors: UInt8  # (N, 32), signs of projections of SIFT
    coarse: Float32  # (h, w), every n-th disparity of the image; NaN = unknown

    def __post_init__(self) -> None:
        freeze(self, "uvd", np.float32, (None, 3))
        freeze(self, "descriptors", np.uint8, (len(self.uvd), _DESCRIPTOR_BYTES))
        freeze(self, "coarse", np.float32, (None, None))
        nowhere = np.isnan(self.uvd[:, :2]).any() or np.isinf(self.uvd).any()
        if nowhere or not self.coarse.size or np.isinf(self.coarse).any():
            raise ShapeError("a keyframe has no disparities, infinite ones, or features nowhere")

    def depth_m(self, camera: RectifiedCamera) -> Float64:
        """Return float64 (h, w), depth of the coarse disparities; NaN = unknown."""
        return depth_from_disparity(self.coarse, camera).astype(np.float64)


def points_of(uvd: NDArray[Any], camera: RectifiedCamera) -> Float64:
    """Return points (N, 3) in camera axes of columns, rows, disparities (N, 3); NaN = unknown."""
    depth = depth_from_disparity(uvd[:, 2], camera).astype(np.float64)
    return unproject(uvd[:, 0].astype(np.float64), uvd[:, 1].astype(np.float64), depth, camera)


def feature_sigma_px(camera: RectifiedCamera) -> float:
    """Standard deviation of a feature's column or row in the image of a camera."""
    return _SIGMA_PX * max(1.0, math.sqrt(camera.width_px * camera.height_px) / _SIZE_PX)


def make_keyframe(frame: int, pair: Rectified, disparity: Disparity) -> Keyframe:
    """Describe a frame for recognition.

    Features are SIFT's, which are found again from other distances and directions. Of a descriptor
    the signs of random projections are kept, whose number of differences grows with the angle
    between two: a quarter of the memory of SIFT's bytes, compared ten times faster.

    Ref: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004; Arandjelović
    and Zisserman, "Three things everyone should know to improve object retrieval", CVPR 2012;
    Charikar, "Similarity estimation techniques from rounding algorithms", STOC 2002.
    """
    disparity = disparity.only_measured()
    sift = cv2.SIFT.create(contrastThreshold=_CONTRAST)
    image, zoom = _reduced(pair.left)
    corners = sift.detect(image)
    places = np.asarray(cv2.KeyPoint.convert(corners), np.float32).reshape(-1, 2)
    # OpenCV halves places in its doubled image as if pixels had their centres at a corner.
    uv = ((places - _DOUBLED_PX + 0.5) / zoom - 0.5).astype(np.float32)
    chosen = _spread(corners, uv, pair.left.shape)
    uv = uv[chosen]
    # Half of the corners are left out; a descriptor takes longer than all that finds a corner.
    sifts = sift.compute(image, [corners[n] for n in chosen])[1]
    descriptors = _signs(np.zeros((0, 128), np.float32) if sifts is None else sifts)
    uvd = np.column_stack([uv, _disparity(disparity, uv, pair.camera)])
    return Keyframe(frame, uvd.astype(np.float32), descriptors, coarse_of(disparity))


def coarse_of(disparity: Disparity) -> Float32:
    """Return every n-th disparity of every n-th row; NaN where none was measured."""
    sampled = (slice(_COARSE_PX // 2, None, _COARSE_PX),) * 2
    return np.where(disparity.measured[sampled], disparity.values[sampled], np.float32(np.nan))


def coarse_grid(coarse: Float32, camera: RectifiedCamera) -> tuple[int, int]:
    """Pixels between coarse samples, and the place of the first."""
    rows = coarse.shape[0]
    step = max(1, round(camera.height_px / rows)) if rows else 1
    return step, step // 2


def coarse_points(coarse: Float32, camera: RectifiedCamera) -> Float64:
    """Points (N, 3) in camera axes of the coarse samples that have a disparity."""
    row, column = np.nonzero(coarse + camera.doffs_px > 1.0)
    step, half = coarse_grid(coarse, camera)
    d = coarse[row, column]
    uvd = np.column_stack([column * step + half, row * step + half, d]).astype(np.float64)
    return points_of(uvd, camera)


def _reduced(image: UInt8) -> tuple[UInt8, Float32]:
    """The image in which features are sought, and its zoom (2,) along row and column."""
    height, width = image.shape
    zoom = min(1.0, _SIZE_PX / math.sqrt(image.size))
    size = (max(1, round(zoom * width)), max(1, round(zoom * height)))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return small, np.array([size[0] / width, size[1] / height], np.float32)


def _signs(sifts: Float32) -> UInt8:
    """Signs of random projections of the roots of descriptors (N, 128), as bits (N, 32)."""
    roots = np.sqrt(sifts / np.maximum(sifts.sum(axis=1, keepdims=True), 1e-9))
    return np.asarray(np.packbits(roots @ _projections() > 0.0, axis=1))


@lru_cache
def _projections() -> Float32:
    """Directions (128, 256), all across that of the mean, in which all descriptors are alike."""
    directions = np.random.default_rng(0).standard_normal((128, 8 * _DESCRIPTOR_BYTES))
    return np.asarray(directions - directions.mean(axis=0), np.float32)


def words_of(descriptors: UInt8) -> NDArray[np.uint32]:
    """The distinct words of an image's descriptors (N, 32), sorted.

    A word is the value of some fixed bits of a descriptor: similar descriptors are likely to share
    one, different ones are not, and no vocabulary has to be trained.

    Ref: Gionis, Indyk, Motwani, "Similarity search in high dimensions via hashing", VLDB 1999.
    """
    bits = np.unpackbits(descriptors, axis=1)[:, _chosen_bits()]
    values = bits.reshape(len(bits), WORDS, _BITS) @ (1 << np.arange(_BITS, dtype=np.uint32))
    numbered = values + (np.arange(WORDS, dtype=np.uint32) << _BITS)
    return distinct_keys(numbered.astype(np.uint32).ravel())


@lru_cache
def _chosen_bits() -> NDArray[np.intp]:
    """Which bits form the words; tables share none while there are enough bits."""
    shuffled = np.random.default_rng(0).permutation(8 * _DESCRIPTOR_BYTES)
    return np.resize(shuffled, WORDS * _BITS)


def _spread(corners: Sequence[Any], uv: Float32, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """The strongest corners of all cells, rank after rank, until there are enough."""
    strength = np.array([corner.response for corner in corners], np.float32)
    column, row = (uv // _CELL_PX).astype(np.int64).T
    cell = row * -(-shape[1] // _CELL_PX) + column
    by_cell = np.lexsort((uv[:, 1], uv[:, 0], -strength, cell))
    sizes = np.unique(cell, return_counts=True)[1]
    rank = np.arange(len(cell)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return by_cell[np.lexsort((cell[by_cell], rank))[:FEATURES]]


def _disparity(disparity: Disparity, uv: Float32, camera: RectifiedCamera) -> Float32:
    """The disparity (N,) at features; NaN where unknown, small, or unlike neighbours."""
    around, _ = values_around(disparity.values, uv, 1)
    middle = np.median(around, axis=1)
    with np.errstate(invalid="ignore"):
        good = np.abs(around - middle[:, None]).max(axis=1) <= _MAX_DISPARITY_STEP_PX
        good &= middle + camera.doffs_px >= _MIN_DISPARITY_PX
    return np.where(good, middle, np.nan).astype(np.float32)
