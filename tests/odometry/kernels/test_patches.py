"""The compiled placing of patches equals its reference."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.odometry.kernels import patches
from recon.odometry.kernels.patches import Placing
from tests.odometry.kernels.patches_reference import place_patches_reference

PLACING = Placing(radius=4, steps=6, close=0.01, reach=3.0)


def place_patches(
    source: np.ndarray, target: np.ndarray, *places: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
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
def test_placing_equals_its_reference(seed: int, smooth: float, turn: float, growth: float) -> None:
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


def test_a_patch_without_texture_has_no_place() -> None:
    flat = np.full((30, 34), 128, np.uint8)
    uv = np.array([[15.0, 15.0]])
    place, correlation = place_patches(flat, flat, uv, np.eye(2)[None], uv)
    assert np.isnan(place).all()
    assert np.isnan(correlation).all()


def test_an_edge_in_one_direction_has_no_place() -> None:
    edge = np.where(np.arange(34) < 15, 50, 200)[None].repeat(30, axis=0).astype(np.uint8)
    uv = np.array([[15.0, 15.0]])
    place, _ = place_patches(edge, edge, uv, np.eye(2)[None], uv)
    assert np.isnan(place).all()
