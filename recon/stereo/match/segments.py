"""Planes of segments: of parts of an image that no edge divides, at several sizes of an edge.

What windows cannot tell in the middle of a plain wall, its rim and its few marks can.
"""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial
from typing import Final

import cv2
import numpy as np

from recon.core.kernels.compiled import UInt16
from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import Float32, Float64, Int64, UInt8
from recon.stereo.kernels import segments as kernels
from recon.stereo.match import search as common

_EDGES: Final = (3, 6, 12, 24)
"""Differences of neighbouring colours, over three channels, above which there is an edge: from the
noise of a good image to what divides any two surfaces. Which is right differs within one image, so
the planes of all are offered."""
SEGMENTATIONS: Final = len(_EDGES)
SAME_SURFACE_PX: Final = 1.0  # disparities that are farther apart are of two surfaces
_LEAST_PX: Final = 100  # smaller segments have the planes of windows
_Known = tuple[Float32, Float32, Int64, Int64, Int64, Float64, float]
_TRIES: Final = 150  # planes through three pixels: one of them is right where a third lies on it


def fit_segments(
    guide: UInt8, seen: Disparity, to: Float32, pool: Executor, threads: int
) -> Float32:
    """Write the planes of the pixels in segments that have one, (SEGMENTATIONS, 3, H, W).

    ``guide``, uint8 (H, W, 3), are smoothed colours. What was seen counts by its confidence.
    Returns which fraction of the segment of a pixel lies on its plane, float32 (SEGMENTATIONS, H, W).
    """
    ratios = np.zeros((SEGMENTATIONS, *guide.shape[:2]), np.float32)
    steps, draws = _steps(guide), np.random.default_rng(0).random((_TRIES, 3))
    for edge, planes, ratio in zip(_EDGES, to, ratios, strict=True):
        alike = (steps <= edge).view(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(alike, connectivity=4)
        sizes = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
        starts, order = np.concatenate([[0], np.cumsum(sizes)]), np.empty(steps.size, np.int64)
        kernels.sort_by_label(labels.ravel(), starts, order)
        wanted = np.flatnonzero(sizes >= _LEAST_PX)
        wanted = wanted[wanted > 0]  # 0 are edges
        if len(wanted):
            known = seen.values, seen.confidence, order, starts, wanted, draws, SAME_SURFACE_PX
            fit = partial(_fit, known, planes, ratio)
            common.in_strips(pool, threads, fit, len(wanted))
    return ratios


def _fit(known: _Known, to: Float32, ratios: Float32, segments: range) -> None:
    kernels.fit_segments(*known, segments.start, segments.stop, to, ratios)


def smooth_colours(pair: RectifiedPair) -> UInt8:
    """Return the colours of the left view, uint8 (H, W, 3), without the noise of single pixels."""
    colours = pair.left_rgb
    if colours is None:
        colours = np.repeat(pair.left[..., None], 3, axis=2)
    return np.asarray(cv2.blur(colours, (3, 3)), dtype=np.uint8)


def _steps(guide: UInt8) -> UInt16:
    """Return by how much each pixel differs from those above and to the left, over the channels."""
    steps = np.zeros(guide.shape[:2], np.uint16)
    steps[1:] = cv2.absdiff(guide[1:], guide[:-1]).sum(axis=2, dtype=np.uint16)
    beside = cv2.absdiff(guide[:, 1:], guide[:, :-1]).sum(axis=2, dtype=np.uint16)
    steps[:, 1:] = np.maximum(steps[:, 1:], beside)
    return steps
