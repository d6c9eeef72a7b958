"""Filling of holes: a disparity for every pixel, for the dense metrics of benchmarks."""

from __future__ import annotations

import numpy as np

from recon.core.values.arrays import Bool, Float32, Int32, frozen_array


def fill_holes(values: Float32) -> Float32:
    """Give each pixel without a disparity that of the background beside it.

    What only one camera sees is hidden behind something nearer, so a hole gets the smaller one of
    the nearest values to the left and to the right on its row, or the only one. A row without any
    value is copied from the nearest row with some, the upper one of two. Known values stay.

    Args:
        values: float32 (H, W), pixels; NaN = none.

    Returns:
        float32 (H, W); all NaN where ``values`` are, else without NaN.

    Raises:
        ShapeError: The array has another dtype or shape.

    Ref: the background interpolation of A. Geiger et al., KITTI stereo development kit.
    """
    values = frozen_array("values", values, np.float32, (None, None))
    known = np.isfinite(values)
    from_left = _gather(values, _last_known(known))
    from_right = _gather(values[:, ::-1], _last_known(known[:, ::-1]))[:, ::-1]
    filled = np.where(known, values, np.fmin(from_left, from_right))
    rows = np.asarray(known.any(axis=1))
    return filled[_nearest_of(rows)] if rows.any() else filled


def _last_known(known: Bool) -> Int32:
    """Return int32 (H, W): column of the nearest known pixel at or left of each; -1 = none."""
    columns = np.arange(known.shape[1], dtype=np.int32)
    return np.asarray(np.maximum.accumulate(np.where(known, columns, np.int32(-1)), axis=1))


def _gather(values: Float32, columns: Int32) -> Float32:
    there = np.take_along_axis(values, np.maximum(columns, 0).astype(np.intp), axis=1)
    return np.where(columns >= 0, there, np.float32(np.nan))


def _nearest_of(rows: Bool) -> Int32:
    """Return int32 (H,): for each row the nearest one that is True."""
    found = np.flatnonzero(rows)
    number = np.arange(len(rows))
    after = np.searchsorted(found, number).clip(0, len(found) - 1)
    before = np.maximum(after - 1, 0)
    upper = np.abs(found[before] - number) <= np.abs(found[after] - number)
    return np.asarray(np.where(upper, found[before], found[after]), dtype=np.int32)
