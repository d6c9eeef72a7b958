"""ICP recovers the motion, also far from the origin, and failures raise our errors."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, make_transform
from recon.evaluation.map import icp


def corner(seed: int) -> np.ndarray:
    """Points on three planes that meet at right angles."""
    sides = np.random.default_rng(seed).uniform(0, 10, (3, 3000, 3))
    for axis in range(3):
        sides[axis, :, axis] = 0
    return sides.reshape(-1, 3)


@pytest.mark.parametrize("away_m", [0.0, 5000.0])
def test_the_motion_between_two_samples_of_a_corner_is_found(away_m: float) -> None:
    here = np.eye(4)
    here[:3, 3] = away_m
    small = make_transform(exp_so3(np.array([0.01, -0.02, 0.015])), np.array([0.3, -0.2, 0.1]))
    T = here @ small @ invert(here)
    found, share = icp(apply(here, corner(0)), apply(T @ here, corner(1)), (2.0, 0.5, 0.2))
    wrong = invert(here) @ invert(T) @ found @ here
    # Random samples of planes: exact up to the normals at the edges of the corner.
    assert np.linalg.norm(wrong[:3, 3]) < 0.01
    assert angle_rad(wrong) < 1e-3
    assert share > 0.9


def test_clouds_that_are_too_far_apart_are_reported() -> None:
    with pytest.raises(RegistrationError, match="no corresponding points"):
        icp(corner(0), corner(1) + 100, (2.0, 0.5))
    xyz = corner(2)
    xyz.flags.writeable = False
    assert icp(xyz, xyz, (1.0,))[1] == 1.0
