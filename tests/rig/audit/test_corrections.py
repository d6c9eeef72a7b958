"""What exact tracks of a drive show of a turned right camera and of bent lenses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from recon.rig.audit.corrections import (
    BentLenses,
    RightTurn,
    bending,
    estimate_lenses,
    estimate_turn,
    straightened,
    turned_places,
    turning,
)
from recon.rig.audit.rig_fit import RigCorrection, StereoTracks
from recon.rig.audit.seen_motion import SeenMotion

from recon.core.geometry.projection import project
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.odometry.window import TrackWindow
from recon.rig.audit import rig_fit
from recon.rig.audit.findings import of_turn
from recon.stereo.rectify.lens import rays_of

CAMERA = RectifiedCamera(700.0, 600.0, 180.0, 600.0, 0.5, 1200, 370)
CENTRE = np.array([CAMERA.cx_px, CAMERA.cy_px])
LEFT = np.array([8e-3, -3e-3, -1e-3, 5e-4, 2e-3, -1e-3])
RIGHT = np.array([5e-3, -2e-3, 1e-3, 2e-3, -3e-3, 1e-3])
NONE = np.zeros(6)
NOISE_PX = 0.1
FRAMES = 6


def tracks(turn: np.ndarray, seed: int) -> StereoTracks:
    """Points on a street, seen from six poses, by a right camera that a turn would correct."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(6.0, 60.0, 150)
    xyz = np.column_stack(
        [rng.uniform(-0.7, 0.7, 150) * depth, rng.uniform(-0.2, 0.2, 150) * depth, depth]
    )
    step = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([0.0, 0.0, 1.0]))
    poses = np.stack([np.linalg.matrix_power(step, k) for k in range(FRAMES)])
    uvd, right = np.full((FRAMES, 150, 3), np.nan), np.full((FRAMES, 150, 2), np.nan)
    for k, T in enumerate(poses):
        u, v, d = project(apply(invert(T), xyz), CAMERA)
        seen = (u > 0) & (u < CAMERA.width_px) & (v > 0) & (v < CAMERA.height_px)
        # The inverse of a small turn is the turn by as much the other way.
        there = turned_places(np.column_stack([u - d, v]), -turn, CAMERA)
        off = rng.normal(0.0, NOISE_PX, (2, 150, 2))
        uvd[k, seen] = np.column_stack([np.column_stack([u, v]) + off[0], d])[seen]
        right[k, seen] = (there + off[1])[seen]
    start = xyz + rng.normal(0.0, 0.02, xyz.shape) * depth[:, None] * [0, 0, 1]
    return StereoTracks(TrackWindow(poses, uvd, start), right)


@pytest.mark.parametrize("correct", [turning, bending])
def test_places_follow_a_correction_as_its_derivatives_say(
    correct: Callable[[RectifiedCamera], RigCorrection],
) -> None:
    correction, seen, step = correct(CAMERA), tracks(np.zeros(5), 0), 1e-5
    at = correction.place(seen, np.zeros(len(correction.prior)))
    for k, one in enumerate(step * np.eye(len(correction.prior))):
        there, back = correction.place(seen, one), correction.place(seen, -one)
        for ahead, behind, derivative in (
            (there.left_uv, back.left_uv, at.by_left),
            (there.right_uv, back.right_uv, at.by_right),
        ):
            numeric = (ahead - behind) / (2 * step)
            # Of hundreds of pixels per radian; the bend of a place that bends is left out.
            np.testing.assert_allclose(
                numeric, np.where(np.isnan(numeric), np.nan, derivative[..., k]), atol=0.05
            )


def test_what_is_seen_follows_a_place_as_its_derivatives_say() -> None:
    xyz, step = np.random.default_rng(0).uniform((-3, -1, 4), (3, 1, 20), (50, 3)), 1e-6
    derivative = rig_fit._derivative(xyz[None], CAMERA)[0]
    for k, one in enumerate(step * np.eye(3)):
        ahead, behind = (np.stack(project(p, CAMERA), axis=1) for p in (xyz + one, xyz - one))
        np.testing.assert_allclose((ahead - behind) / (2 * step), derivative[..., k], atol=1e-4)


@pytest.mark.parametrize(
    "turn",
    [
        (2e-3, 0.0, 0.0, 0.0, 0.0),
        (0.0, 1e-3, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 2e-3, 0.0),
        (1e-3, 7e-4, -2e-3, -1e-3, 1e-3),
    ],
)
def test_a_turn_of_the_right_camera_is_recovered(turn: tuple[float, ...]) -> None:
    found = estimate_turn([tracks(np.array(turn), seed) for seed in range(10)], CAMERA)
    # 5e-5 rad are 0.035 px.
    np.testing.assert_allclose(found.values[:4], turn[:4], atol=5e-5)
    shown = np.array(turn[:4]) != 0
    shown[[1, 3]] &= turn[4] == 0  # lenses that bend may stand behind yaw and focal length
    assert (found.telling[shown] == found.values[:4][shown]).all()
    assert not found.telling[[1, 3]].any() or turn[4] == 0


def test_nothing_is_invented_and_intervals_hold() -> None:
    rigs = [
        estimate_turn([tracks(np.zeros(5), 100 * n + seed) for seed in range(12)], CAMERA)
        for n in range(8)
    ]
    offs = np.array([rig.values / rig.sigmas for rig in rigs if rig])
    assert offs.shape == (8, 5)
    assert np.abs([rig.values[:4] for rig in rigs if rig]).max() * CAMERA.focal_px < 0.05
    assert 0.5 < np.sqrt(np.mean(offs**2)) < 1.6


def bent(uv: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Where a lens shows what is straight."""
    xy = (uv - CENTRE) / CAMERA.focal_px
    found = xy
    for _ in range(20):
        found = found + xy - straightened(found, terms)
    return found * CAMERA.focal_px + CENTRE


def drive(left: np.ndarray, right: np.ndarray) -> list[StereoTracks]:
    found = []
    for seed in range(12):
        straight = tracks(np.zeros(5), seed)
        uvd = straight.window.uvd.copy()
        uvd[..., :2] = bent(uvd[..., :2], left)
        window = replace(straight.window, uvd=uvd)
        found.append(StereoTracks(window, bent(straight.right_uv, right)))
    return found


def test_rows_meet_and_disparities_fit_with_the_lenses_that_are_found() -> None:
    found = estimate_lenses(drive(LEFT, RIGHT), CAMERA)
    v, u = np.mgrid[20:350:12j, 150:1050:20j]
    uv = np.stack([u, v], axis=-1)
    rig = found.calibration
    for depth_px in (10.0, 30.0):
        seen = (bent(uv, LEFT), bent(uv - [depth_px, 0.0], RIGHT))
        left, right = (
            rays_of(camera, each.reshape(-1, 2))
            for camera, each in zip((rig.left, rig.right), seen, strict=True)
        )
        right = right @ rig.T_right_left[:3, :3]
        off = CAMERA.focal_px * (left / left[:, 2:] - right / right[:, 2:])
        # Before, rows are off by 0.6 px and disparities by 1.3 px (root mean square).
        assert np.sqrt(np.mean(off[:, 1] ** 2)) < 0.05
        assert 0.99 < np.median(off[:, 0]) / depth_px < 1.01
        assert np.std(off[:, 0]) < 0.15
    moved = [np.linalg.norm(bent(uv, terms) - uv, axis=-1) for terms in (LEFT, RIGHT)]
    rms = [float(np.sqrt(np.square(each).mean())) for each in moved]
    # The places above leave out the borders, where lenses move most.
    assert all(1 < got / inner < 3 for got, inner in zip(found.moved_px, rms, strict=True))


def test_straight_lenses_are_left_alone_and_few_windows_show_nothing() -> None:
    assert estimate_lenses(drive(NONE, NONE), CAMERA) is None
    assert estimate_lenses(drive(LEFT, RIGHT)[:5], CAMERA) is None
    assert estimate_turn([tracks(np.zeros(5), seed) for seed in range(5)], CAMERA) is None


@pytest.mark.parametrize("terms", [LEFT, RIGHT, NONE])
def test_the_calibration_has_the_lenses_in_opencvs_order(terms: np.ndarray) -> None:
    rig = BentLenses(CAMERA, np.zeros(4), terms, NONE).calibration
    v, u = np.mgrid[0:369:5j, 0:1199:9j]
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    rays = rays_of(rig.left, uv)
    expected = straightened((uv - CENTRE) / CAMERA.focal_px, terms)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], expected, atol=1e-7)


@pytest.mark.parametrize(("left", "right", "codes"), [(LEFT, RIGHT, []), (NONE, NONE, ["yaw"])])
def test_what_bent_lenses_explain_better_is_no_turn(
    left: np.ndarray, right: np.ndarray, codes: list[str]
) -> None:
    yaw = RightTurn(np.array([0.0, 1.0 / CAMERA.focal_px, 0.0, 0.0, 0.0]), 1e-12 * np.eye(5), 12)
    motion = SeenMotion(yaw, tuple(drive(left, right)), None)
    assert [code for code, _ in of_turn(CAMERA, motion, CAMERA)] == codes
