"""Halves of the features disagree by what each half is off."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.camera import project
from recon.look.fit import disagreement
from recon.odometry.pose import TrackWindow

CAMERA = RectifiedCamera(
    focal_px=700.0,
    cx_px=600.0,
    cy_px=180.0,
    cx_right_px=600.0,
    baseline_m=0.54,
    width_px=1200,
    height_px=360,
)
FRAMES, STEP_M = 6, 1.0


def seen(points: int, seed: int, noise_px: float = 0.02) -> TrackWindow:
    """A camera that drives ahead past points all over its view, each of which it sees."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(12.0, 40.0, points)
    uv = np.stack([rng.uniform(300, 900, points), rng.uniform(90, 270, points)], axis=1)
    rays = np.column_stack([(uv - [CAMERA.cx_px, CAMERA.cy_px]) / CAMERA.focal_px, np.ones(points)])
    xyz = rays * depth[:, None]
    poses = np.stack([make_transform(np.eye(3), np.array([0, 0, k * STEP_M])) for k in range(6)])
    uvd = np.stack([np.stack(project(xyz - T[:3, 3], CAMERA), axis=1) for T in poses])
    return TrackWindow(poses, uvd + rng.normal(0.0, noise_px, uvd.shape), xyz)


def biased(window: TrackWindow, which: np.ndarray, ratio: float) -> TrackWindow:
    """The same, with disparities of some points too small by a ratio, as a wrong rig shows them."""
    uvd = window.uvd.copy()
    uvd[:, which, 2] *= 1.0 - ratio
    z = window.xyz_world.copy()
    z[which] /= 1.0 - ratio
    return replace(window, uvd=uvd, xyz_world=z)


def windows(ratio: float, place) -> list[TrackWindow]:
    some = [seen(240, seed) for seed in range(6)]
    return [biased(one, place(one), ratio) for one in some]


def test_what_is_off_on_one_side_is_stated_with_half_of_its_size():
    right = windows(0.02, lambda w: w.uvd[0, :, 0] > CAMERA.cx_px)
    assert disagreement(right, CAMERA) == pytest.approx(0.01, rel=0.25)
    low = windows(0.02, lambda w: w.uvd[0, :, 1] > CAMERA.cy_px)
    assert disagreement(low, CAMERA) == pytest.approx(0.01, rel=0.25)
    near = windows(0.02, lambda w: w.xyz_world[:, 2] < 25.0)
    assert 0.004 < disagreement(near, CAMERA) < 0.015


def test_where_all_are_right_or_off_alike_halves_agree():
    """What all features share, such as a wrong baseline, no half can show."""
    for ratio in (0.0, 0.02):
        alike = windows(ratio, lambda w: np.ones(len(w.xyz_world), np.bool_))
        assert disagreement(alike, CAMERA) < 0.001


def test_windows_with_few_features_say_nothing():
    few = [seen(24, seed) for seed in range(6)]
    assert np.isnan(disagreement(few, CAMERA))
    many = windows(0.02, lambda w: w.uvd[0, :, 0] > CAMERA.cx_px)
    assert disagreement([*few, *many], CAMERA) == disagreement(many, CAMERA)
