"""`recon.stereo.kernels.tiles` in plain numpy: slow, short, and the definition of its results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.stereo.kernels.tiles import GROUP, Support, Tiles


def offer_supported_reference(
    halved: NDArray[np.float32], minimum: int, ndisp: int, support: Support, tiles: Tiles
) -> NDArray[np.bool_]:
    """Return what `recon.stereo.kernels.tiles.offer_supported` writes to ``offered``."""
    y = 2 * np.arange(halved.shape[0])[:, None]
    x = 2 * np.arange(halved.shape[1])[None, :]
    k = np.clip(np.rint(2 * halved) - minimum, 0, ndisp - 1)
    offered = np.zeros_like(tiles.offered)
    for i, j, group in np.ndindex(*offered.shape):
        top, left = i * tiles.height - support.margin_y, j * tiles.width - support.margin_x
        bottom = (i + 1) * tiles.height + support.margin_y
        right = (j + 1) * tiles.width + support.margin_x
        seen = (y // 2 >= top // 2) & (y // 2 < bottom // 2)
        seen = seen & (x // 2 >= left // 2) & (x // 2 < right // 2)
        matched = np.count_nonzero(seen & np.isfinite(halved))
        near = (k >= group * GROUP - support.margin) & (k < (group + 1) * GROUP + support.margin)
        enough = np.count_nonzero(seen & near) >= max(support.share * matched, support.least)
        offered[i, j, group] = enough or matched < support.matched * np.count_nonzero(seen)
    return offered


def offered_reference(tiles: Tiles, shape: tuple[int, int], ndisp: int) -> NDArray[np.bool_]:
    """Return bool (H, W, ndisp), which candidates are offered to which pixel."""
    y, x = np.arange(shape[0]) // tiles.height, np.arange(shape[1]) // tiles.width
    return tiles.offered[y[:, None, None], x[:, None], np.arange(ndisp) // GROUP]
