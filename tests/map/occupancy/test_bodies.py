"""What came or went as one body, told from what is hit and looked through without order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon.commands.config import load_config
from recon.core.geometry import se3
from recon.core.kernels.voxels import pack_keys
from recon.core.values import PointCloud
from recon.core.values.grid import log_odds
from recon.map.occupancy.bodies import Looks, came_or_went
from recon.map.occupancy.builder import MAX_PROBABILITY, OccupancyBuilder, thin_rays

WALL = np.stack(np.meshgrid(np.arange(8), [0], np.arange(8)), -1).reshape(-1, 3)
FRAMES = 30


def _judged(cells: np.ndarray, seen: np.ndarray, placed: np.ndarray | None = None) -> np.ndarray:
    """Judge cells (N, 3) of which frames saw (F, N)."""
    keys = pack_keys(cells)
    order = np.argsort(keys)
    sure = np.ones(len(cells), np.bool_) if placed is None else placed
    judged = np.zeros(len(cells), np.bool_)
    judged[order] = came_or_went(keys[order], sure[order], seen[:, order].astype(np.int8))
    return judged


def _while(frames: slice, number: int) -> np.ndarray:
    seen = np.full((FRAMES, number), -1)
    seen[frames] = 1
    return seen


def test_what_was_there_as_a_whole_for_a_while_came_or_went() -> None:
    once = _while(slice(10, 15), len(WALL))
    assert _judged(WALL, once).all()
    # Two that pass one after the other.
    twice = once.copy()
    twice[20:24] = 1
    assert _judged(WALL, twice).all()
    # Column after column is hit, each for six frames: it enters by one edge.
    since = np.arange(FRAMES)[:, None] - 2 * WALL[:, 0]
    assert _judged(WALL, np.where((since >= 3) & (since < 9), 1, -1)).all()


def test_what_each_frame_hits_at_random_did_not_move() -> None:
    for share in (0.1, 0.3, 0.5):
        rng = np.random.default_rng(3)
        seen = np.where(rng.random((FRAMES, len(WALL))) < share, 1, -1)
        assert not _judged(WALL, seen).any()
    # Boards of a fence are hit or looked through from top to bottom, whatever the others are.
    boards = rng.random((FRAMES, 8)) < 0.3
    assert not _judged(WALL, np.where(boards[:, WALL[:, 0]], 1, -1)).any()
    for always in (-1, 0, 1):
        assert not _judged(WALL, np.full((FRAMES, len(WALL)), always)).any()
    # Beside a body, but apart from it.
    cells = np.concatenate([WALL, WALL + np.array([20, 0, 0])])
    judged = _judged(cells, np.concatenate([_while(slice(5, 9), len(WALL)), seen], axis=1))
    assert judged.tolist() == [True] * len(WALL) + [False] * len(WALL)
    assert len(_judged(WALL[:0], np.zeros((FRAMES, 0)))) == 0


def test_a_cell_alone_moved_if_it_was_hit_in_one_run_of_frames() -> None:
    cell = WALL[:1]
    assert _judged(cell, _while(slice(3, 5), 1)).all()
    twice = _while(slice(3, 5), 1)
    twice[9] = 1
    assert not _judged(cell, twice).any()
    never_through = np.zeros((FRAMES, 1), np.int8)
    never_through[3:5] = 1
    assert not _judged(cell, never_through).any()


def test_cells_that_frames_could_place_outweigh_the_others_of_their_piece() -> None:
    placed = WALL[:, 0] < 3
    rng = np.random.default_rng(9)
    noise = np.where(rng.random((FRAMES, len(WALL))) < 0.4, 1, -1)
    body = _while(slice(5, 9), len(WALL))
    assert _judged(WALL, np.where(placed, body, noise), placed).all()
    assert not _judged(WALL, np.where(placed, noise, body), placed).any()
    assert _judged(WALL, body, np.zeros(len(WALL), np.bool_)).all()


def test_cells_of_which_too_little_is_known_belong_to_a_body_beside_them() -> None:
    beside = [[9, 0, 0], [12, 0, 0]]  # each two cells from the one before, both alone
    seen = np.concatenate([_while(slice(5, 9), len(WALL)), np.zeros((FRAMES, 2))], axis=1)
    assert _judged(np.concatenate([WALL, beside]), seen)[len(WALL) :].tolist() == [True, False]


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
        builder = OccupancyBuilder(SETTINGS, np.eye(4))
        builder.integrate(cloud.cloud(), T)
        seen = replace(builder.part(), points=None).voxels(SETTINGS.resolution_m)
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
