"""Keyframes for place recognition: features with disparity, and coarse disparities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import ShapeError
from recon.core.kernels.voxels import distinct_keys
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float32, Float64, UInt8, freeze
from recon.core.values.camera import depth_from_disparity, unproject

_DESCRIPTOR_BYTES: Final = 32
_EDGE_PX: Final = 16  # half of the patch that a descriptor looks at
_SURPLUS: Final = 3  # corners to choose from, per feature
# Up to 1.3⁴ = 2.9 times the size. OpenCV's eight scales, 1.2 apart, take a third longer, and 118
# pairs of kitti_raw_0013's frames gave 111 loops instead of 110.
_SCALE_STEP: Final = 1.3
_SCALES: Final = 5
FEATURES: Final = 500  # features of a keyframe
_CELL_PX: Final = 48  # edge of the cells that features are spread over
_FAST_THRESHOLD: Final = 10  # threshold of the FAST corner detector
_MIN_DISPARITY_PX: Final = 1.0  # features with less disparity have no usable depth
_MAX_DISPARITY_STEP_PX: Final = 1.0  # largest difference between a disparity and its neighbours
_COARSE_PX: Final = 8  # every n-th disparity of a row and column is kept
_SAME_SCALE: Final = 0.1
"""Share by which a scale may differ before features look different: half a step of the scales."""

_MOST_ZOOM: Final = 4.0  # images of a still larger or smaller scale are described as they are
WORDS: Final = 4  # words per descriptor (hash tables)
_BITS: Final = 20  # bits of a descriptor per word


@dataclass(frozen=True, eq=False)
class Keyframe:
    """What is kept of a frame to recognise its place."""

    frame: int  # number of the frame in the drive
    # float32 (N, 3), column, row and disparity of each feature; disparity NaN = unknown
    uvd: Float32
    descriptors: UInt8  # (N, 32), ORB
    coarse: Float32  # (h, w), every n-th disparity of the image; NaN = unknown

    def __post_init__(self) -> None:
        freeze(self, "uvd", np.float32, (None, 3))
        freeze(self, "descriptors", np.uint8, (len(self.uvd), _DESCRIPTOR_BYTES))
        freeze(self, "coarse", np.float32, (None, None))
        nowhere = np.isnan(self.uvd[:, :2]).any() or np.isinf(self.uvd).any()
        if nowhere or not self.coarse.size or np.isinf(self.coarse).any():
            raise ShapeError("a keyframe has no disparities, infinite ones, or features nowhere")

    def xyz(self, camera: RectifiedCamera) -> Float64:
        """Return float64 (N, 3), the features in camera axes; NaN where the depth is unknown."""
        return points_of(self.uvd, camera)


def points_of(uvd: NDArray[Any], camera: RectifiedCamera) -> Float64:
    """Return points (N, 3) in camera axes of columns, rows and disparities (N, 3)."""
    depth = depth_from_disparity(uvd[:, 2], camera).astype(np.float64)
    return unproject(uvd[:, 0].astype(np.float64), uvd[:, 1].astype(np.float64), depth, camera)


def make_keyframe(
    frame: int, pair: RectifiedPair, disparity: Disparity, *, focal_px: float | None = None
) -> Keyframe:
    """Describe a frame for recognition.

    With the focal length of the frames that it will be compared with, features are described as
    they look at that scale; None = its own.

    Ref: Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011.
    """
    most, fast = _SURPLUS * FEATURES, _FAST_THRESHOLD
    orb = cv2.ORB.create(most, _SCALE_STEP, _SCALES, edgeThreshold=_EDGE_PX, fastThreshold=fast)
    image, zoom = _at_focal_length(pair, focal_px)
    corners = _spread(orb.detect(image), image.shape)
    described, descriptors = orb.compute(image, corners)
    uv = _places_of(described)
    if image is not pair.left:
        uv = ((uv + 0.5) / zoom - 0.5).astype(np.float32)
    if descriptors is None:
        descriptors = np.zeros((0, _DESCRIPTOR_BYTES), np.uint8)
    uvd = np.column_stack([uv, _disparity(disparity, uv, pair.camera)])
    sampled = np.s_[_COARSE_PX // 2 :: _COARSE_PX]
    coarse = np.ascontiguousarray(disparity.values[sampled, sampled])
    return Keyframe(frame, uvd.astype(np.float32), descriptors, coarse)


def _at_focal_length(pair: RectifiedPair, focal_px: float | None) -> tuple[UInt8, Float32]:
    """The left image as seen with a focal length, and the zoom (2,) along row and column."""
    height, width = pair.left.shape
    zoom = 1.0 if focal_px is None else focal_px / pair.camera.focal_px
    if abs(zoom - 1.0) <= _SAME_SCALE or not 1 / _MOST_ZOOM <= zoom <= _MOST_ZOOM:
        return pair.left, np.ones(2, np.float32)
    size = (max(1, round(zoom * width)), max(1, round(zoom * height)))
    how = cv2.INTER_CUBIC if zoom > 1 else cv2.INTER_AREA
    image = np.asarray(cv2.resize(pair.left, size, interpolation=how), np.uint8)
    return image, np.array([size[0] / width, size[1] / height], np.float32)


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


def _spread(corners: Sequence[Any], shape: tuple[int, ...]) -> Any:
    """The strongest corners of all cells, rank after rank, until there are enough."""
    uv = _places_of(corners)
    strength = np.array([corner.response for corner in corners], np.float32)
    octave = np.array([corner.octave for corner in corners], np.int32)
    column, row = (uv // _CELL_PX).astype(np.int64).T
    cell = row * -(-shape[1] // _CELL_PX) + column
    by_cell = np.lexsort((octave, uv[:, 1], uv[:, 0], -strength, cell))
    sizes = np.unique(cell, return_counts=True)[1]
    rank = np.arange(len(cell)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    chosen = by_cell[np.lexsort((cell[by_cell], rank))[:FEATURES]]
    return [corners[number] for number in chosen.tolist()]


def _places_of(corners: Sequence[Any]) -> Float32:
    """Columns and rows (N, 2) of corners, of which there may be none."""
    return np.asarray(cv2.KeyPoint.convert(corners), np.float32).reshape(-1, 2)


def _disparity(disparity: Disparity, uv: Float32, camera: RectifiedCamera) -> Float32:
    """The disparity (N,) at features; NaN where unknown, small, or unlike neighbours."""
    height, width = disparity.values.shape
    column, row = np.rint(uv).astype(np.int64).T
    step = np.arange(-1, 2)
    rows = np.clip(row[:, None, None] + step[:, None], 0, height - 1)
    columns = np.clip(column[:, None, None] + step, 0, width - 1)
    around = disparity.values[rows, columns].reshape(len(uv), 9)
    centre = around[:, 4]
    around = np.where(np.isfinite(around), around, centre[:, None])
    middle = np.median(around, axis=1)
    with np.errstate(invalid="ignore"):
        good = np.abs(around - middle[:, None]).max(axis=1) <= _MAX_DISPARITY_STEP_PX
        good &= middle + camera.doffs_px >= _MIN_DISPARITY_PX
    return np.where(good, middle, np.nan).astype(np.float32)
