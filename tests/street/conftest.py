"""A small street, rendered once, and a scene of one box with analytic ground truth."""

from __future__ import annotations

import numpy as np
import pytest

from recon.street.path import R_STREET_LEVEL
from recon.street.render import StreetCamera
from recon.street.settings import StreetScene
from recon.street.shapes import Material, Paint, boxes, merge, quads
from recon.street.street import StreetWorld, build_street, rig

SMALL = {"frames": 4, "width_px": 320, "height_px": 120, "focal_px": 180.0, "noise_dn": 0.0}


@pytest.fixture(scope="session")
def small_settings() -> StreetScene:
    return StreetScene(seed=3, **SMALL)


@pytest.fixture(scope="session")
def street(small_settings) -> StreetCamera:
    return StreetCamera(build_street(small_settings))


@pytest.fixture(scope="session")
def box_world() -> StreetWorld:
    """A level road, a wall 20 m ahead, a box of 2 × 2 × 1.8 m whose front is 8 m ahead."""
    settings = StreetScene(
        frames=1, width_px=200, height_px=100, focal_px=100.0, baseline_m=0.5, noise_dn=0.0
    )
    grey = Paint(Material.PLAIN, (0.5, 0.5, 0.5), 1)
    soup = merge(
        [
            quads([-5, -50, 0], [100, 0, 0], [0, 100, 0], grey),
            quads([20, -50, 0], [0, 100, 0], [0, 0, 30], grey),
            boxes([8, -1, 0.01], [10, 1, 1.8], grey),
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = R_STREET_LEVEL
    pose[2, 3] = 1.5
    return StreetWorld(settings, soup, rig(settings), pose[None], np.array([0.0, 0.0, 1.0]))
