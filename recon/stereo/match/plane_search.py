"""From a disparity map with holes to one without: planes that go on from pixel to pixel."""

from __future__ import annotations

from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from typing import Final

import numpy as np

from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import Float32, Int32, UInt8
from recon.stereo.kernels import planes as kernels
from recon.stereo.match import search as common
from recon.stereo.match.holes import fill_holes
from recon.stereo.match.segments import SAME_SURFACE_PX, SEGMENTATIONS, fit_segments, smooth_colours

# Distances that planes come from in each round, near ones in six directions, far ones in three.
_ROUNDS: Final = ((4, 24), (12, 70))
_NEAR_FIT_PX, _FAR_FIT_PX, _LAST_FIT_PX = 12, 30, 5  # half the square that a plane is fitted to
_SAMPLES: Final = 5  # pixels of a fit, from its middle to its side, at least
_COLOUR: Final = 30.0  # difference, over three channels, at which a weight falls to 1/e
NOW, FIRST, FITTED, SEGMENTS = range(4)
"""Whose planes a pixel may take: those chosen last, seen at first, or fitted to either; from there
on those of the segments that it is in."""


def search_planes(
    pair: RectifiedPair,
    seen: Disparity,
    volume: UInt8,
    changes: kernels.Changes,
    threads: int,
) -> Float32:
    """Return the disparity of the plane that each pixel takes, float32 (H, W), without NaN.

    ``volume`` is the cost of each candidate, uint8 (H, P, at least W); ``seen`` was found in it.
    """
    size = pair.left.shape
    filled = fill_holes(seen.values)
    sources = np.zeros((SEGMENTS + SEGMENTATIONS, 3, *size), np.float32)
    sources[:, 0] = np.where(np.isfinite(filled), filled, np.float32(changes.minimum))
    everywhere = np.ones(size, np.float32)
    with ThreadPoolExecutor(threads) as pool:
        fits = _Fits(pair, pool, threads)
        fits.fit(seen.values, seen.confidence, _NEAR_FIT_PX, sources[FIRST], own=True)
        fits.fit(seen.values, seen.confidence, _FAR_FIT_PX, sources[FITTED])
        sources[SEGMENTS:] = sources[FITTED]
        fit_segments(fits.guide, seen, sources[SEGMENTS:], pool, threads)
        sources[NOW] = sources[FIRST]
        for number, (near, far) in enumerate(_ROUNDS):
            table = _table(near, far, number)
            sums = np.empty((2, *size, len(table)), np.float32)
            sweeps = [
                pool.submit(
                    kernels.sweep,
                    *(sources, table, volume, pair.left, changes, upwards, sums[int(upwards)]),
                )
                for upwards in (False, True)
            ]
            for done in sweeps:
                done.result()
            chosen = np.empty((3, *size), np.float32)
            choose = partial(_choose, sums, sources, table, chosen)
            common.in_strips(pool, threads, choose, size[0])
            sources[NOW] = sources[FITTED] = chosen
            last = number + 1 == len(_ROUNDS)
            radius = _LAST_FIT_PX if last else _NEAR_FIT_PX
            fits.fit(chosen[0], everywhere, radius, sources[FITTED])
    # Planes of neighbours on one surface differ by parts of a pixel.
    chosen, fitted = sources[NOW, 0], sources[FITTED, 0]
    near_by = np.abs(fitted - chosen) < SAME_SURFACE_PX / 2
    return np.asarray(np.where(near_by, fitted, chosen), dtype=np.float32)


def _choose(sums: Float32, sources: Float32, table: Int32, to: Float32, rows: range) -> None:
    kernels.choose_planes(sums[0], sums[1], sources, table, rows.start, rows.stop, to)


class _Fits:
    """Fits planes to disparities, of pixels of like colour."""

    def __init__(self, pair: RectifiedPair, pool: Executor, threads: int) -> None:
        self.guide = smooth_colours(pair)
        self._alike = np.exp(np.arange(766) / -_COLOUR).astype(np.float32)
        self._pool, self._threads = pool, threads

    def fit(
        self, values: Float32, weights: Float32, radius: int, to: Float32, *, own: bool = False
    ) -> None:
        """Write the planes of all pixels, (3, H, W); ``own``: with the values that they have."""
        nodes = np.empty((3, *(-(-n // kernels.NODE_PX) for n in values.shape)), np.float32)
        stride = max(1, radius // _SAMPLES)

        def fit_rows(rows: range) -> None:
            kernels.fit_nodes(
                *(values, weights, self.guide, self._alike, radius, stride),
                *(SAME_SURFACE_PX, rows.start, rows.stop, nodes),
            )

        def spread_rows(rows: range) -> None:
            kernels.spread_nodes(nodes, values, own, rows.start, rows.stop, to)

        common.in_strips(self._pool, self._threads, fit_rows, nodes.shape[1])
        common.in_strips(self._pool, self._threads, spread_rows, len(values))


def _table(near: int, far: int, number: int) -> Int32:
    """Return which planes a pixel may take in a round, int32 (K, 3): source, columns and rows."""
    around = []
    for count, reach, turn in ((6, near, 0.3 * number), (3, far, 0.2 + 0.4 * number)):
        angles = turn + 2 * np.pi * np.arange(count) / count
        ends = np.rint(reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(int)
        around += [(NOW, *end) for end in ends]
    here = [(source, 0, 0) for source in (NOW, FIRST, FITTED)]
    planes = [(SEGMENTS + number, 0, 0) for number in range(SEGMENTATIONS)]
    return np.array([*here, *around, *planes], np.int32)
