"""What the motion of a drive shows of a right camera that is turned, from exact tracks."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.projection import project
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.odometry.window import TrackWindow
from recon.rig.audit.corrections import estimate_turn, turned_places
from recon.rig.audit.rig_fit import StereoTracks

CAMERA = RectifiedCamera(
    focal_px=700.0,
    cx_px=600.0,
    cy_px=180.0,
    cx_right_px=600.0,
    baseline_m=0.5,
    width_px=1200,
    height_px=370,
)
NOISE_PX = 0.1
FRAMES = 6


def tracks(turn: np.ndarray, seed: int, step_m: float = 1.0) -> StereoTracks:
    """Points on a street, seen from six poses, by a right camera that a turn would correct."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(6.0, 60.0, 150)
    xyz = np.column_stack(
        [rng.uniform(-0.7, 0.7, 150) * depth, rng.uniform(-0.2, 0.2, 150) * depth, depth]
    )
    step = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([0.0, 0.0, step_m]))
    poses = np.stack([np.linalg.matrix_power(step, k) for k in range(FRAMES)])
    uvd, right = np.full((FRAMES, 150, 3), np.nan), np.full((FRAMES, 150, 2), np.nan)
    for k, T in enumerate(poses):
        u, v, d = project(apply(invert(T), xyz), CAMERA)
        seen = (u > 0) & (u < CAMERA.width_px) & (v > 0) & (v < CAMERA.height_px)
        uv, there = np.column_stack([u, v]), np.column_stack([u - d, v])
        # The inverse of a small turn is the turn by as much the other way.
        there = turned_places(there, -turn, CAMERA)
        off = rng.normal(0.0, NOISE_PX, (2, 150, 2))
        uvd[k, seen] = np.column_stack([uv + off[0], d])[seen]
        right[k, seen] = (there + off[1])[seen]
    start = xyz + rng.normal(0.0, 0.02, xyz.shape) * depth[:, None] * [0, 0, 1]
    return StereoTracks(TrackWindow(poses, uvd, start), right)


@pytest.mark.parametrize(
    "turn",
    [
        (2e-3, 0.0, 0.0, 0.0, 0.0),
        (0.0, 1e-3, 0.0, 0.0, 0.0),
        (0.0, -5e-4, 1e-3, 0.0, 0.0),
        (0.0, 0.0, 0.0, 2e-3, 0.0),
        (1e-3, 7e-4, -2e-3, -1e-3, 1e-3),
    ],
)
def test_a_turn_of_the_right_camera_is_recovered(turn: tuple[float, ...]) -> None:
    found = estimate_turn([tracks(np.array(turn), seed) for seed in range(10)], CAMERA)
    assert found is not None
    # 5e-5 rad are 0.035 px.
    np.testing.assert_allclose(found.values[:4], turn[:4], atol=5e-5)


def test_nothing_is_invented_and_intervals_hold() -> None:
    rigs = [
        estimate_turn([tracks(np.zeros(5), 100 * n + seed) for seed in range(12)], CAMERA)
        for n in range(8)
    ]
    offs = np.array([rig.values / rig.sigmas for rig in rigs if rig])
    assert offs.shape == (8, 5)
    assert np.abs([rig.values[:4] for rig in rigs if rig]).max() * CAMERA.focal_px < 0.05
    assert 0.5 < np.sqrt(np.mean(offs**2)) < 1.6


def test_few_windows_show_nothing() -> None:
    assert estimate_turn([tracks(np.zeros(5), seed) for seed in range(5)], CAMERA) is None
