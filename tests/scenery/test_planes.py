"""Planes have the disparity of the formula, and both images show the same surface."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.values import RectifiedCamera
from tests.scenery.planes import fronto_parallel_pair, slanted_pair, step_pair

CAMERA = RectifiedCamera(200.0, 99.5, 49.5, 99.5, 0.5, 200, 100)


@pytest.mark.parametrize(
    "scene",
    [
        fronto_parallel_pair(replace(CAMERA, cx_right_px=109.5), 8.0),
        slanted_pair(CAMERA, 6.0, (0.4, 0.3)),
        step_pair(CAMERA, 4.0, 9.0, 25.0),
    ],
    ids=["doffs", "slanted", "step"],
)
def test_warping_by_the_truth_reproduces_the_left_view(scene):
    d, mask = scene.truth.values.astype(np.float64), scene.truth.nonocc.copy()
    v, u = np.mgrid[0:100, 0:200].astype(np.float32)
    x = (u - np.nan_to_num(d)).astype(np.float32)
    fetched = cv2.remap(scene.pair.right.astype(np.float32), x, v, cv2.INTER_LANCZOS4)
    mask &= (x >= 4) & (x <= d.shape[1] - 5)
    # Lanczos interpolation of a texture that has power up to Nyquist, both views rounded.
    error = np.abs(fetched - scene.pair.left)[mask]
    assert np.median(error) < 2.0
    assert np.percentile(error, 95) < 6.0
    # A wrong disparity would be seen: a pixel off costs many grey levels.
    assert np.abs(np.diff(scene.pair.left.astype(int), axis=1)).mean() > 6.0


def test_the_occluded_strip_is_as_wide_as_the_step_in_disparity():
    scene = step_pair(CAMERA, 5.0, 10.0, 30.0)
    # d = 20 and 10 px: the ten columns left of the square, and the ten that leave the image.
    expected = np.ones(200, dtype=bool)
    expected[:10] = False
    square = np.flatnonzero(scene.truth.values[50] > 15)
    expected[square[0] - 10 : square[0]] = False
    assert len(square) == 60
    assert np.array_equal(scene.truth.nonocc[50], expected)
