"""Drives whose cameras are mounted askew, mapped level by all their frames."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.geometry.se3 import exp_so3, invert
from recon.map.drive.sequence import map_sequence
from recon.map.settings import DriveSettings
from recon.street.render import StreetCamera
from recon.street.settings import StreetScene
from recon.street.street import build_street
from tests.scenery.film import Film

_FRAMES = 10


def _askew(rotation_deg: tuple[float, float, float]) -> Film:
    """A street, seen by a camera that is turned in its mount."""
    scene = StreetScene(
        frames=_FRAMES, width_px=240, height_px=160, focal_px=140.0, smooth_edges=False,
        camera_height_m=2.0, pitch_deg=0.0, yaw_deg=0.0, roll_deg=0.0, sway=0.0,
        speed_m_per_frame=0.6,
    )  # fmt: skip
    world = build_street(scene)
    T = world.T_street_camera.copy()
    T[:, :3, :3] = T[:, :3, :3] @ exp_so3(np.radians(rotation_deg))
    camera = StreetCamera(replace(world, T_street_camera=T))
    poses = invert(T[0]) @ T
    poses[0] = np.eye(4)
    return Film([camera.pair(n) for n in range(_FRAMES)], world.camera, poses)


@pytest.mark.slow
@pytest.mark.parametrize("rotation_deg", [(0, 0, 45), (0, 0, 180), (-60, 0, 0), (-90, 0, 0)])
def test_a_camera_mounted_askew_gives_a_level_map(
    rotation_deg: tuple[float, float, float],
) -> None:
    film = _askew(rotation_deg)
    mapped = map_sequence(film, DriveSettings(), known_poses=film.trajectory)
    up = exp_so3(np.radians(rotation_deg)).T @ [0.0, -1.0, 0.0]
    assert mapped.session.level.by == "surfaces"
    assert np.degrees(np.arccos(mapped.T_map_world[2, :3] @ up)) < 2.0
    # Occupancy lies where the cloud does, though it was first made in other axes.
    occupied_m = mapped.voxels.centres_m[mapped.voxels.log_odds > 0]
    ground_m = np.percentile(np.concatenate([tile.cloud.xyz[:, 2] for tile in mapped.tiles]), 20)
    assert np.percentile(occupied_m[:, 2], 20) == pytest.approx(ground_m, abs=0.3)


def test_what_is_set_to_be_up_is_up() -> None:
    film = _askew((-90, 0, 0)).taken(slice(0, 3))
    config = DriveSettings.parse({"axes": {"up": (0.0, 0.0, -2.0)}})
    mapped = map_sequence(film, config, known_poses=film.trajectory)
    assert mapped.session.level.by == "setting"
    np.testing.assert_allclose(mapped.T_map_world[2, :3], [0, 0, -1], atol=1e-9)


@pytest.mark.parametrize("up", [(0, 0, 0), (float("nan"), 0, 1), (float("inf"), 0, 0), (1, 2)])
def test_what_is_no_direction_is_refused(up: tuple[float, ...]) -> None:
    with pytest.raises(SettingsError, match="up"):
        DriveSettings.parse({"axes": {"up": up}})
