"""What single frames saw of some cells is what all their rays did to them."""

from __future__ import annotations

import numpy as np

from recon.commands.config import load_config
from recon.core.geometry import se3
from recon.core.kernels.voxels import pack_keys
from recon.core.values import PointCloud
from recon.core.values.grid import log_odds
from recon.map.occupancy.bodies import Looks
from recon.map.occupancy.builder import MAX_PROBABILITY, OccupancyBuilder, thin_rays

SETTINGS = load_config().occupancy


def _frames(number: int) -> tuple[np.ndarray, list[PointCloud]]:
    """Poses that look here and there, and clouds of slopes up to 1.2 on either side."""
    rng = np.random.default_rng(4)
    poses, clouds = [], []
    for _ in range(number):
        turn = se3.exp_so3(rng.normal(0.0, 0.5, 3))
        poses.append(se3.make_transform(turn, rng.normal(0.0, 1.0, 3)))
        depth = np.repeat(rng.uniform(1.0, 20.0, 300), 30)
        slopes = np.repeat(rng.uniform(-1.2, 1.2, (300, 2)), 30, axis=0)
        slopes += rng.normal(0.0, 0.01, slopes.shape)
        xyz = np.column_stack([slopes * depth[:, None], depth]).astype("f4")
        clouds.append(PointCloud(xyz, sigma_m=(0.002 * depth**2).astype("f4")))
    return np.stack(poses), clouds


def test_chosen_rays_see_in_cells_what_all_rays_see() -> None:
    poses, clouds = _frames(6)
    rays = [thin_rays(cloud, SETTINGS) for cloud in clouds]
    rng = np.random.default_rng(8)
    ends = [se3.apply(T, cloud.xyz[::50]) for T, cloud in zip(poses, clouds, strict=True)]
    hit = np.floor(np.concatenate(ends) / SETTINGS.resolution_m).astype(np.int64)
    cells = np.unique(np.concatenate([rng.integers(-40, 40, (4000, 3)), hit]), axis=0)
    looks = np.stack(list(Looks(SETTINGS, poses, rays.__getitem__).at(pack_keys(cells))))
    assert len(looks) == len(poses)
    assert min((looks == sign).sum() for sign in (-1, 0, 1)) > 100
    for T, cloud, look in zip(poses, rays, looks, strict=True):
        builder = OccupancyBuilder(SETTINGS.model_copy(update={"thin_surfaces": False}), np.eye(4))
        builder.integrate(cloud.cloud(), T)
        seen = builder.voxels()
        assert np.abs(seen.log_odds).max() < log_odds(MAX_PROBABILITY)  # one frame clamps nothing
        known = dict(zip(pack_keys(seen.keys).tolist(), np.sign(seen.log_odds), strict=True))
        assert [known.get(key, 0) for key in pack_keys(cells).tolist()] == look.tolist()


def test_frames_that_are_too_far_away_or_look_elsewhere_are_not_read() -> None:
    poses, clouds = _frames(2)
    poses[0] = np.eye(4)
    poses[1] = se3.make_transform(np.eye(3), np.array([0.0, 0.0, 60.0]))
    rays = [thin_rays(cloud, SETTINGS) for cloud in clouds]
    read: list[int] = []

    def reading(number: int) -> object:
        read.append(number)
        return rays[number]

    ahead = pack_keys(np.array([[0, 0, 40]]))
    assert len(list(Looks(SETTINGS, poses, reading).at(ahead))) == 1
    assert read == [0]
    behind = pack_keys(np.array([[0, 0, -40]]))
    assert not list(Looks(SETTINGS, poses, reading).at(behind))
