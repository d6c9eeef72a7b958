"""What is up by normals of surfaces, of worlds that are level, and of such that are not."""

import math

import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values.arrays import Float64
from recon.map.ground.level import NOT_KNOWN, TOO_FEW, level_by_surfaces

_UP = np.array([0.0, 0.0, 1.0])
_LEVEL = np.array(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
)  # axes of a camera, x ahead


def _street(rng: np.random.Generator, ground: float = 0.5, ceiling: float = 0.0) -> Float64:
    """Normals of ground, façades along x, and things in all directions; z is up."""
    kinds = rng.choice(4, 20_000, p=[ground, ceiling, 0.8 - ground - ceiling, 0.2])
    side = np.where(rng.random(20_000) < 0.5, 1.0, -1.0)
    clean = np.select(
        [kinds[:, None] == n for n in range(3)],
        [_UP, -_UP, side[:, None] * [0.0, 1.0, 0.0]],
        rng.standard_normal((20_000, 3)),
    )
    noisy = clean + 0.03 * rng.standard_normal(clean.shape)
    return noisy / np.linalg.norm(noisy, axis=1)[:, None]


def _path(R_world_camera: Float64, direction: Float64) -> Float64:
    steps = np.arange(20)[:, None] * direction
    return np.stack([make_transform(R_world_camera, step) for step in steps])


def _mounted(pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Float64:
    turns = np.radians([[-pitch_deg, 0.0, 0.0], [0.0, 0.0, roll_deg]])
    return _LEVEL @ exp_so3(turns[0]) @ exp_so3(turns[1])


def _off_deg(normals: Float64, path: Float64, turned: Float64) -> tuple[float, str]:
    """Return how far what is found is off up, in a world that is turned, and by what."""
    T = make_transform(turned, np.zeros(3))
    up, level = level_by_surfaces(normals @ turned.T, T @ path)
    off = math.nan if up is None else math.degrees(math.acos(np.clip(up @ turned @ _UP, -1, 1)))
    return off, level.by


@pytest.mark.parametrize("pitch_deg", [0, 30, 60, 90])
@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_drives_forward_is_level_however_far_it_looks_down(
    pitch_deg: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    path = _path(_mounted(pitch_deg), np.array([1.0, 0.0, 0.0]))
    off, by = _off_deg(_street(rng), path, exp_so3(rng.uniform(-3, 3, 3)))
    assert by == "surfaces"
    assert off < 0.3


@pytest.mark.parametrize("roll_deg", [10, 45, 170, 180])
def test_a_rolled_camera_is_level_also_upside_down(roll_deg: float) -> None:
    rng = np.random.default_rng(0)
    path = _path(_mounted(0, roll_deg), np.array([1.0, 0.0, 0.0]))
    off, by = _off_deg(_street(rng), path, exp_so3(rng.uniform(-3, 3, 3)))
    assert by == "surfaces"
    assert off < 0.3


def test_a_wall_that_a_camera_moves_along_is_no_ground() -> None:
    rng = np.random.default_rng(0)
    wall = _street(rng, ground=0.8)[:, [2, 1, 0]] * [-1.0, 1.0, 1.0]  # ahead of the camera
    path = _path(_mounted(), np.array([0.0, 1.0, 0.0]))
    assert _off_deg(wall, path, np.eye(3))[1] == NOT_KNOWN


def test_between_floor_and_ceiling_the_camera_is_believed() -> None:
    normals = _street(np.random.default_rng(0), ground=0.35, ceiling=0.3)
    assert _off_deg(normals, _path(_mounted(), np.array([1.0, 0.0, 0.0])), np.eye(3))[0] < 0.3


def test_under_a_ceiling_alone_a_rolled_camera_knows_nothing() -> None:
    normals = _street(np.random.default_rng(0), ground=0.0, ceiling=0.5)
    path = _path(_mounted(0, 90), np.array([1.0, 0.0, 0.0]))
    assert _off_deg(normals, path, np.eye(3))[1] == NOT_KNOWN


def test_one_wall_shows_no_vertical() -> None:
    normals = _street(np.random.default_rng(0), ground=0.0)
    path = _path(_mounted(), np.array([1.0, 0.0, 0.0]))
    assert _off_deg(normals, path, np.eye(3))[1] == NOT_KNOWN


@pytest.mark.parametrize("seed", range(4))
def test_the_inside_of_a_body_has_no_up(seed: int) -> None:
    rng = np.random.default_rng(seed)
    facing = rng.standard_normal((20_000, 3)) * 0.6 + [-1.0, 0.0, 0.0]
    facing /= np.linalg.norm(facing, axis=1)[:, None]
    path = _path(_mounted(), np.array([0.3, 0.0, 0.1]))
    up, level = level_by_surfaces(facing, path)
    assert up is None
    assert level.by == NOT_KNOWN
    assert "axes.up" in level.warnings[0]


def test_too_little_contradicts_nothing() -> None:
    normals = np.tile(_UP, (100, 1))
    up, level = level_by_surfaces(normals, _path(_mounted(), _UP))
    assert up is None
    assert level.why == TOO_FEW


def test_uneven_ground_is_known_less_well() -> None:
    rng = np.random.default_rng(1)
    tilts = np.radians(rng.normal(0.0, 6.0, (16, 2)))
    parts = [_street(rng)[:1000] @ exp_so3(np.append(tilt, 0.0)).T for tilt in tilts]
    path = _path(_mounted(), np.array([1.0, 0.0, 0.0]))
    up, uneven = level_by_surfaces(np.concatenate(parts), path)
    _, even = level_by_surfaces(_street(rng), path)
    assert up is not None
    assert even.sigma_deg < uneven.sigma_deg
    assert math.degrees(math.acos(up @ _UP)) < 3 * uneven.sigma_deg
