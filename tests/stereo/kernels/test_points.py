"""The compiled back-projection equals its reference."""

from __future__ import annotations

import numba
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.core.kernels.compiled import Bool, Float32, Float64
from recon.stereo.kernels.points import MIN_SPREAD, Maps, PointRules, Points, make_points

RULES = PointRules(100.0, 12.3, 7.7, 20.0, 2.0, 0.1, 8.0, 0.2, 0.2, stride=1, radius=3)


def make_maps(seed: int, height: int, width: int, *, known: float, channels: int) -> Maps:
    """A slanted surface with noise, steps, holes, negative values."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    values = 6 + 0.3 * u - 0.2 * v + np.where(u > width // 2, 9.0, 0.0)
    values += rng.normal(0, 0.3, values.shape)
    values[rng.random(values.shape) < 0.05] = -3.0
    values[rng.random(values.shape) > known] = np.nan
    made = Maps(
        values.astype(np.float32),
        rng.random(values.shape).astype(np.float32),
        rng.uniform(0.05, 0.6, values.shape).astype(np.float32),
        rng.integers(0, 256, (height, width, channels), dtype=np.uint8),
        rng.random(values.shape) < 0.9 if channels == 3 else np.zeros((0, 0), np.bool_),
    )
    for image in made[:-1]:
        image.flags.writeable = False  # as those of a disparity: kernels are compiled for them
    return made


maps = st.builds(
    make_maps,
    seed=st.integers(0, 2**20),
    height=st.integers(1, 20),
    width=st.integers(1, 30),
    known=st.sampled_from([0.0, 0.1, 0.6, 1.0]),
    channels=st.sampled_from([1, 3]),
)


@given(maps, st.integers(0, 4), st.integers(1, 3))
@settings(max_examples=150)
def test_points_equal_their_reference(given_maps: Maps, radius: int, stride: int) -> None:
    rules = RULES._replace(radius=radius, stride=stride)
    ours = make_points(given_maps, rules)
    reference = make_points_reference(given_maps, rules)
    # Both compute in float64 and round to float32 at the end: to its next value at most.
    rtol, atol = 2.0**-23, 0.0
    if numba.config.DISABLE_JIT:
        # numpy then does each of three operations in float32, and first rounds the principal point
        # (below 32 px) to it; that is multiplied by depth (below 10 m) over focal length (100 px).
        rtol, atol = 4 * 2.0**-23, 32 * 2.0**-24 * 10 / 100
    np.testing.assert_allclose(ours.xyz, reference.xyz, rtol=rtol, atol=atol)
    np.testing.assert_allclose(ours.sigma, reference.sigma, rtol=2.0**-23)
    np.testing.assert_array_equal(ours.confidence, reference.confidence)
    np.testing.assert_array_equal(ours.colours, reference.colours)
    # The kernel adds up to 81 disparities below 26 px in float32, each within 4 px of the centre,
    # in 18 steps: a covariance is off by 38 · 2^-24 · 4 · 26 = 2.4e-4 at most, a slope by that over
    # the window's variance across its narrow side (0.2 where few pixels are known: 1.2e-3), and the
    # direction by 100 (the focal length) times that over the normal's length (60 on this slope).
    np.testing.assert_allclose(ours.normals, reference.normals, atol=2e-3)


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


def _candidates(maps: Maps, rules: PointRules) -> Bool:
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


def _slopes(values: Float32, at: Index, radius: int) -> tuple[Float64, Float64]:
    """Disparity gradients (along u, along v) of the plane fitted to the window of each pixel."""
    padded = np.pad(values.astype(np.float64), radius, constant_values=np.nan)
    offset = np.arange(-radius, radius + 1)
    rows = at[0][:, None, None] + radius + offset[:, None]
    columns = at[1][:, None, None] + radius + offset
    d = padded[rows, columns].reshape(len(at[0]), offset.size**2)
    du, dv = (a.ravel()[None] for a in np.meshgrid(offset, offset))
    known = np.isfinite(d)
    n = known.sum(axis=1, keepdims=True)

    def centred(x: NDArray[np.floating | np.integer]) -> Float64:
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
