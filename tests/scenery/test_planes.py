"""Planes have the disparity of the formula, and both images show the same surface."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.core.values import RectifiedCamera
from tests.scenery.planes import fronto_parallel_pair, slanted_pair, step_pair

CAMERA = RectifiedCamera(200.0, 99.5, 49.5, 99.5, 0.5, 200, 100)


def _warp_error(scene) -> np.ndarray:
    """Grey-level difference of the left view and the right one fetched by the truth."""
    d, mask = scene.truth.values.astype(np.float64), scene.truth.nonocc.copy()
    v, u = np.mgrid[0 : d.shape[0], 0 : d.shape[1]].astype(np.float32)
    x = (u - np.nan_to_num(d)).astype(np.float32)
    fetched = cv2.remap(scene.pair.right.astype(np.float32), x, v, cv2.INTER_LANCZOS4)
    mask &= (x >= 4) & (x <= d.shape[1] - 5)
    return np.abs(fetched - scene.pair.left)[mask]


def test_doffs_shifts_the_disparity():
    camera = RectifiedCamera(200.0, 99.5, 49.5, 109.5, 0.5, 200, 100)
    scene = fronto_parallel_pair(camera, 8.0)
    assert np.allclose(scene.truth.values, 12.5 - 10.0, rtol=1e-5)
    assert np.percentile(_warp_error(scene), 95) < 3.0


def test_disparity_of_a_slanted_plane_is_linear_in_the_image():
    d = slanted_pair(CAMERA, 10.0, (0.5, -0.2)).truth.values.astype(np.float64)
    v, u = np.mgrid[0:100, 0:200]
    x, y = (u - 99.5) / 200, (v - 49.5) / 200
    # Z = 10 + 0.5 X - 0.2 Y along a ray: Z·(1 - 0.5 x + 0.2 y) = 10.
    assert np.allclose(d, 100.0 * (1 - 0.5 * x + 0.2 * y) / 10.0, rtol=1e-6)


@pytest.mark.parametrize(
    "scene",
    [
        fronto_parallel_pair(CAMERA, 7.3),
        slanted_pair(CAMERA, 6.0, (0.4, 0.3)),
        step_pair(CAMERA, 4.0, 9.0, 25.0),
    ],
    ids=["fronto", "slanted", "step"],
)
def test_warping_by_the_truth_reproduces_the_left_view(scene):
    # Lanczos interpolation of a texture that has power up to Nyquist, both views rounded.
    error = _warp_error(scene)
    assert np.median(error) < 2.0
    assert np.percentile(error, 95) < 6.0
    # A wrong disparity would be seen: a pixel off costs many grey levels.
    assert np.abs(np.diff(scene.pair.left.astype(int), axis=1)).mean() > 6.0


def test_the_occluded_strip_is_as_wide_as_the_step_in_disparity():
    scene = step_pair(CAMERA, 5.0, 10.0, 30.0)
    row = scene.truth.nonocc[50]
    # d = 20 and 10 px: the ten columns left of the square, and the ten that leave the image.
    expected = np.ones(200, dtype=bool)
    expected[:10] = False
    square = np.flatnonzero(scene.truth.values[50] > 15)
    expected[square[0] - 10 : square[0]] = False
    assert len(square) == 60
    assert np.array_equal(row, expected)
