"""`recon.stereo.kernels.points` in plain numpy: the definition of its results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.stereo.kernels.points import MIN_SPREAD, Maps, PointRules, Points

Float32 = NDArray[np.float32]
Index = tuple[NDArray[np.intp], NDArray[np.intp]]


def make_points_reference(maps: Maps, rules: PointRules) -> Points:
    """Reference implementation of `recon.stereo.kernels.points.make_points`, all pixels at once."""
    rows, columns = np.nonzero(_candidates(maps, rules))
    with np.errstate(divide="ignore"):
        z = (rules.fb / (maps.values[rows, columns].astype(np.float64) + rules.doffs)).astype("f4")
        error = (z.astype(np.float64) ** 2 * maps.sigma[rows, columns] / rules.fb).astype("f4")
    keep = (z >= rules.nearest) & (z <= rules.farthest)
    with np.errstate(invalid="ignore"):
        keep &= error <= rules.relative_sigma * z.astype(np.float64)
    rows, columns, z, error = rows[keep], columns[keep], z[keep], error[keep]
    colours = maps.colours[rows, columns]
    return Points(
        xyz=np.stack(
            [(columns - rules.cx) * z / rules.focal, (rows - rules.cy) * z / rules.focal, z], axis=1
        ).astype(np.float32),
        normals=_normals(maps.values, (rows, columns), rules)
        if rules.radius
        else np.zeros((0, 3), np.float32),
        sigma=error,
        confidence=maps.confidence[rows, columns],
        colours=np.repeat(colours, 3, axis=1) if colours.shape[1] == 1 else colours,
    )


def _candidates(maps: Maps, rules: PointRules) -> NDArray[np.bool_]:
    """Return bool (H, W), pixels on the raster that have a disparity and are sure enough."""
    with np.errstate(invalid="ignore"):
        candidates = maps.values.astype(np.float64) + rules.doffs > 0
    candidates &= maps.confidence >= rules.confidence
    if maps.usable.size:
        candidates &= maps.usable
    raster = np.zeros_like(candidates)
    raster[:: rules.stride, :: rules.stride] = True
    return np.asarray(candidates & raster)


def _normals(values: Float32, at: Index, rules: PointRules) -> Float32:
    slope_u, slope_v = _slopes(values, at, rules.radius)
    rows, columns = at
    centre = values[at] + rules.doffs - slope_u * (columns - rules.cx)
    centre -= slope_v * (rows - rules.cy)
    normals = -np.stack([slope_u * rules.focal, slope_v * rules.focal, centre], axis=1)
    length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.asarray(normals / length, dtype=np.float32)


def _slopes(
    values: Float32, at: Index, radius: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Disparity gradients (along u, along v) of the plane fitted to the window of each pixel."""
    padded = np.pad(values.astype(np.float64), radius, constant_values=np.nan)
    offset = np.arange(-radius, radius + 1)
    rows = at[0][:, None, None] + radius + offset[:, None]
    columns = at[1][:, None, None] + radius + offset
    d = padded[rows, columns].reshape(len(at[0]), offset.size**2)
    du, dv = (a.ravel()[None] for a in np.meshgrid(offset, offset))
    known = np.isfinite(d)
    n = known.sum(axis=1, keepdims=True)

    def centred(x: NDArray[np.floating | np.integer]) -> NDArray[np.float64]:
        x = np.where(known, x, 0.0).astype(np.float64)
        return np.where(known, x - x.sum(axis=1, keepdims=True) / n, 0.0)

    u, v, d = centred(du), centred(dv), centred(d)
    uu, vv, uv, ud, vd = (
        (a * b).sum(axis=1) / n[:, 0] for a, b in ((u, u), (v, v), (u, v), (u, d), (v, d))
    )
    determinant = uu * vv - uv**2
    flat = determinant > MIN_SPREAD
    inverse = np.where(flat, 1.0, 0.0) / np.where(flat, determinant, 1.0)
    return (ud * vv - vd * uv) * inverse, (vd * uu - ud * uv) * inverse
