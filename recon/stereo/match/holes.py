"""Disparity where nothing was matched, by what is beside it."""

from __future__ import annotations

import numpy as np

from recon.core.geometry.alignment import nearest_sorted
from recon.core.values.arrays import Float32, frozen_array


def fill_holes(values: Float32) -> Float32:
    """Give each pixel without a disparity that of the background beside it: float32 (H, W).

    That is the smaller of the nearest values to the left and to the right, or the only one. A row
    without any is copied from the nearest row with some, the upper one of two.

    Ref: the background interpolation of A. Geiger et al., KITTI stereo development kit.
    """
    values = frozen_array("values", values, np.float32, (None, None))
    known = np.isfinite(values)
    background = np.fmin(_from_left(values), _from_left(values[:, ::-1])[:, ::-1])
    filled = np.where(known, values, background)
    rows = np.flatnonzero(known.any(axis=1))
    return filled[rows[nearest_sorted(np.arange(len(filled)), rows)]] if rows.size else filled


def _from_left(values: Float32) -> Float32:
    """Return float32 (H, W): the nearest known value at or left of each; NaN = none."""
    columns = np.where(np.isfinite(values), np.arange(values.shape[1], dtype=np.int32), -1)
    last = np.maximum.accumulate(columns, axis=1)
    there = np.take_along_axis(values, np.maximum(last, 0).astype(np.intp), axis=1)
    return np.where(last >= 0, there, np.float32(np.nan))
