"""Rows of pixels continued beyond the borders of an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel


@kernel
def continue_row(row: NDArray[np.uint8], at: int, longer: NDArray[np.uint8]) -> None:
    """Copy a row into a longer one, whose other values become the nearest value of the row.

    Args:
        row: uint8 (W,).
        at: Where its first value goes, which may be outside.
        longer: uint8 (C,), written.
    """
    start = min(max(at, 0), longer.size)
    end = min(max(at + row.size, 0), longer.size)
    longer[:start] = row[0]
    longer[end:] = row[-1]
    shown, inside = row[start - at :], longer[start:end]
    for c in range(inside.size):
        inside[c] = shown[c]
