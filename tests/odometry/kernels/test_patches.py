"""The compiled placing of patches equals its reference."""

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.odometry.kernels import patches
from recon.odometry.kernels.patches import LEAST_POWER, Placing

PLACING = Placing(radius=4, steps=6, close=0.01, reach=3.0)


def place_patches(source, target, *places):
    """Place patches in read-only images, as all are in the program: others are compiled anew."""
    for image in (source, target):
        image.setflags(write=False)
    return patches.place_patches(source, target, *places, PLACING)


@given(
    seed=st.integers(0, 2**20),
    smooth=st.sampled_from([0.0, 1.0, 3.0]),
    turn=st.floats(-0.3, 0.3),
    growth=st.floats(0.6, 1.6),
)
@settings(max_examples=40)
def test_placing_equals_its_reference(seed, smooth, turn, growth):
    rng = np.random.default_rng(seed)
    source, target = (image(rng, smooth) for _ in range(2))
    uv = rng.uniform(-3, 35, (12, 2))
    uv[0] = np.nan
    warp = growth * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    warp = warp + rng.normal(0, 0.05, (12, 2, 2))
    guess = uv + rng.normal(0, 1, (12, 2))
    ours = place_patches(source, target, uv, warp, guess)
    reference = place_patches_reference(source, target, uv, warp, guess, PLACING)
    for found, expected in zip(ours, reference, strict=True):
        # Sums in another order: a step of a badly conditioned patch magnifies their rounding.
        np.testing.assert_allclose(found, expected, atol=1e-5)


def image(rng: np.random.Generator, smooth: float) -> np.ndarray:
    grey = rng.uniform(0, 255, (30, 34))
    if smooth:
        grey = cv2.GaussianBlur(grey, (0, 0), smooth)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def test_a_patch_without_texture_or_with_edges_of_one_direction_has_no_place():
    flat = np.full((30, 34), 128, np.uint8)
    edge = np.where(np.arange(34) < 15, 50, 200)[None].repeat(30, axis=0).astype(np.uint8)
    uv = np.array([[15.0, 15.0]])
    for grey in (flat, edge):
        place, correlation = place_patches(grey, grey, uv, np.eye(2)[None], uv)
        assert np.isnan(place).all()
        assert np.isnan(correlation).all()


Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]


def place_patches_reference(source, target, uv, warp, guess, placing):
    place, correlation = np.full((len(uv), 2), np.nan), np.full(len(uv), np.nan)
    for n in range(len(uv)):
        wide = _cut(source, uv[n], np.eye(2), placing.radius + 1)
        if wide is not None:
            place[n], correlation[n] = _place(wide, target, warp[n], guess[n], placing)
    return place, correlation


def _place(wide, target, warp, guess, placing):
    """Place one patch, given a pixel wider than it is; NaN where that fails."""
    lost = np.full(2, np.nan), float("nan")
    by_v, by_u = (np.asarray(slope)[1:-1, 1:-1] for slope in np.gradient(wide))
    patch = _centred(wide[1:-1, 1:-1])
    J = np.stack([_centred(by_u), _centred(by_v)], axis=1)
    power = float(patch @ patch)
    H = J.T @ J
    if power < LEAST_POWER * len(patch) or not np.linalg.det(H) > 1e-9 * H[0, 0] * H[1, 1]:
        return lost
    uv, correlation = guess, float("nan")
    for _ in range(placing.steps):
        cut = _cut(target, uv, warp, placing.radius)
        if cut is None:
            return lost
        there = _centred(cut)
        there *= np.sqrt(power / max(float(there @ there), LEAST_POWER))
        correlation = float(there @ patch) / power
        step = np.linalg.solve(H, J.T @ (there - patch))
        uv = uv - warp @ step
        if not (np.abs(uv - guess) <= placing.reach).all():
            return lost
        if step @ step < placing.close**2:
            break
    return uv, correlation


def _cut(image: UInt8, uv: Float64, warp: Float64, radius: int) -> Float64 | None:
    """Interpolate a warped patch; None where it leaves the image."""
    reach = radius * np.abs(warp).sum(axis=1)
    last = np.array(image.shape[::-1]) - 1
    if not ((uv - reach >= 0) & (uv + reach < last)).all():
        return None
    offset = np.arange(-radius, radius + 1)
    x, y = np.moveaxis(uv + np.stack(np.meshgrid(offset, offset), axis=-1) @ warp.T, -1, 0)
    column, row = x.astype(np.int64), y.astype(np.int64)
    right, down = x - column, y - row
    grey = image.astype(np.float64)
    above = grey[row, column] * (1 - right) + grey[row, column + 1] * right
    below = grey[row + 1, column] * (1 - right) + grey[row + 1, column + 1] * right
    return np.asarray(above * (1 - down) + below * down)


def _centred(patch: Float64) -> Float64:
    return np.asarray(patch - patch.mean()).ravel()
