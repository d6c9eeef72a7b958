"""What the motion of a drive shows of lenses that bend otherwise than calibrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.rig.audit.audit import _turn_faults
from recon.rig.audit.corrections import BentLenses, RightTurn, estimate_lenses, straightened
from recon.rig.audit.rig_fit import StereoTracks
from recon.rig.audit.seen_motion import SeenMotion
from recon.stereo.rectify.lens import rays_of
from tests.rig.audit.test_right_turn import CAMERA, tracks

LEFT = np.array([8e-3, -3e-3, -1e-3, 5e-4, 2e-3, -1e-3])
RIGHT = np.array([5e-3, -2e-3, 1e-3, 2e-3, -3e-3, 1e-3])
CENTRE = np.array([CAMERA.cx_px, CAMERA.cy_px])
NONE = np.zeros(6)


def bent(uv: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Where a lens shows what is straight."""
    xy = (uv - CENTRE) / CAMERA.focal_px
    found = xy
    for _ in range(20):
        found = found + xy - straightened(found, terms)
    return found * CAMERA.focal_px + CENTRE


def bent_tracks(left: np.ndarray, right: np.ndarray, seed: int) -> StereoTracks:
    straight = tracks(np.zeros(5), seed)
    uvd = straight.window.uvd.copy()
    uvd[..., :2] = bent(uvd[..., :2], left)
    return StereoTracks(replace(straight.window, uvd=uvd), bent(straight.right_uv, right))


def drive(left: np.ndarray, right: np.ndarray) -> list[StereoTracks]:
    return [bent_tracks(left, right, seed) for seed in range(12)]


def test_rows_meet_and_disparities_fit_with_the_lenses_that_are_found() -> None:
    found = estimate_lenses(drive(LEFT, RIGHT), CAMERA)
    assert found is not None
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


def test_straight_lenses_are_left_alone() -> None:
    assert estimate_lenses(drive(NONE, NONE), CAMERA) is None


def test_few_windows_show_nothing() -> None:
    assert estimate_lenses(drive(LEFT, RIGHT)[:5], CAMERA) is None


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
    assert [found.code for found in _turn_faults(CAMERA, motion, CAMERA)] == codes
