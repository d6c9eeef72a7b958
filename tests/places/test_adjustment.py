"""A path with closed loops is adjusted to points that its keyframes share, where that helps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import apply, as_step, as_transform, invert
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.camera import project
from recon.places import adjustment
from recon.places.adjustment import Bundle, Sightings, adjust_path, shared_points
from recon.places.closure import Closure
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import Keyframe
from recon.places.pose_graph import PoseEdge, PoseGraph
from tests.places.conftest import KeyframeMemory, drifted, drive_path, true_loop

CAMERA = RectifiedCamera(300.0, 239.5, 179.5, 239.5, 0.2, 480, 360)
FRAMES, LAP = 30, 24
SIGMA_PX, SIGMA_D_PX = 0.5, 0.3


def _circle() -> Trajectory:
    """A camera that looks outwards and comes back to where it was."""
    turns = 2 * math.pi * np.arange(FRAMES) / LAP
    poses = [
        as_transform(np.array([0, 0, 0, 0, turn, 0])) @ as_transform(np.eye(6)[2]) for turn in turns
    ]
    return Trajectory(np.stack(poses), np.arange(FRAMES) * 1.0)


def _walls(rng: np.random.Generator) -> np.ndarray:
    """Points on the walls of a round room."""
    around, height = rng.uniform(0, 2 * math.pi, 3000), rng.uniform(-2.5, 2.5, 3000)
    far = rng.uniform(5.0, 9.0, 3000)
    return np.column_stack([far * np.sin(around), height, far * np.cos(around)])


def _keyframes(truth: Trajectory, seed: int, wrong: float = 0.0) -> KeyframeMemory:
    """What a camera sees of the walls; some features are where others are."""
    rng, store = np.random.default_rng(seed), KeyframeMemory()
    xyz = _walls(rng)
    words = rng.integers(0, 256, (len(xyz), 32), np.uint8)
    for frame, T in enumerate(truth.T_world_camera):
        uvd = np.stack(project(apply(invert(T), xyz), CAMERA), axis=1)
        size = CAMERA.width_px, CAMERA.height_px
        with np.errstate(invalid="ignore"):
            seen = ((uvd[:, :2] > 0) & (uvd[:, :2] < size) & (uvd[:, 2:] > 1)).all(axis=1)
        noise = rng.normal(size=(len(uvd), 3)) * (SIGMA_PX, SIGMA_PX, SIGMA_D_PX)
        noise += np.where(rng.random((len(uvd), 1)) < wrong, 3.0, 0.0)
        features = Keyframe(
            frame, np.float32(uvd + noise)[seen], words[seen], np.ones((45, 60), "f4")
        )
        store.put(StoredKeyframe(features, T, 0.0))
    return store


def _off_m(path: Trajectory, truth: Trajectory) -> float:
    return float(np.linalg.norm(path.positions_m - truth.positions_m, axis=1).max())


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    return _circle()


@pytest.fixture(scope="module")
def closed(truth) -> Closure:
    """A path whose loops are closed, but which is bent all the same."""
    loops = tuple(true_loop(truth, k, k + LAP) for k in range(FRAMES - LAP))
    most = np.array([0.05, 0.02, 0.05, 0.002, 0.004, 0.002])
    bent = truth.T_world_camera @ np.stack(
        [as_transform(most * math.sin(k)) for k in range(FRAMES)]
    )
    return Closure(replace(truth, T_world_camera=bent), loops, ())


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_noise_leaves_centimetres_and_wrong_points_no_more(truth, closed, wrong):
    odometry = drifted(truth, ratio=0.005, turn_deg_per_m=0.05)
    found = adjust_path(drive_path(odometry), closed, _keyframes(truth, 1, wrong), CAMERA)
    assert found is not None
    first = closed.trajectory.T_world_camera[0] @ invert(truth.T_world_camera[0])
    assert np.array_equal(found.trajectory.T_world_camera[0], closed.trajectory.T_world_camera[0])
    aligned = replace(truth, T_world_camera=first @ truth.T_world_camera)
    assert _off_m(found.trajectory, aligned) < 0.02 < 0.3 * _off_m(closed.trajectory, aligned)
    assert found.figures.left_out_after_px < found.figures.left_out_before_px
    assert found.figures.keyframes == FRAMES


def test_what_fits_no_better_is_not_used(truth, closed, monkeypatch):
    path, store = drive_path(truth), _keyframes(truth, 2)
    exact = replace(closed, trajectory=truth)
    assert adjust_path(path, replace(exact, closed=()), store, CAMERA) is None
    assert adjust_path(path, exact, KeyframeMemory(), CAMERA) is None
    fit, worse = Bundle.fit, closed.trajectory.T_world_camera
    monkeypatch.setattr(
        Bundle,
        "fit",
        lambda one, T: (worse, fit(one, T)[1]) if one.graph.free.any() else fit(one, T),
    )
    assert adjust_path(path, exact, store, CAMERA) is None


def test_a_drive_of_too_many_keyframes_is_thinned(truth, closed, monkeypatch):
    monkeypatch.setattr(adjustment, "_MOST_KEYFRAMES", 15)
    monkeypatch.setattr(adjustment, "_MOST_SIGHTINGS", 1000)
    found = adjust_path(drive_path(truth), closed, _keyframes(truth, 3), CAMERA)
    assert found is not None
    assert found.figures.keyframes <= 15
    assert found.figures.points < 500


def test_points_that_keyframes_share_are_where_a_path_puts_them(truth, closed):
    path, store = drive_path(truth), _keyframes(truth, 4, 0.1)
    exact = replace(closed, trajectory=truth)
    found = shared_points(path, exact, store, CAMERA, range(5, FRAMES))
    assert found.frames.tolist() == [*range(5, FRAMES)]
    assert len(found.xyz) == found.seen.points > 500
    walls = _walls(np.random.default_rng(4))
    off_m = [np.linalg.norm(walls - one, axis=1).min() for one in found.xyz[::10]]
    assert np.median(off_m) < 0.15
    assert min(np.bincount(found.seen.point)) >= 2
    assert not len(shared_points(path, exact, store, CAMERA, [7]).xyz)


def _bundle(seed: int) -> tuple[Bundle, np.ndarray, np.ndarray]:
    """Three nodes, an edge between the first two, and what they see; the true poses and points."""
    rng = np.random.default_rng(seed)
    T = np.stack([as_transform(rng.normal(0.0, 0.05, 6)) for _ in range(3)])
    xyz = rng.uniform([-1.5, -1.0, 3.0], [1.5, 1.0, 6.0], (15, 3))
    node, point = np.divmod(np.flatnonzero(rng.random(45) < 0.9), 15)
    uvd = np.stack(
        [project(apply(invert(T[n]), xyz[[p]]), CAMERA) for n, p in zip(node, point, strict=True)]
    )
    uvd = uvd[:, :, 0] + rng.normal(size=(len(uvd), 3)) * (SIGMA_PX, SIGMA_PX, SIGMA_D_PX)
    sigmas = np.repeat([0.02, 0.004], 3)
    motion = invert(T[0]) @ T[1] @ as_transform(sigmas * rng.normal(size=6))
    edges = [PoseEdge(0, 1, motion, np.diag(sigmas**-2))]
    graph = replace(PoseGraph.of(edges, math.inf, 3), free=np.array([False, True, True]))
    seen = Sightings(node, point, uvd)
    return Bundle(graph, seen, CAMERA, (SIGMA_PX, SIGMA_D_PX), 1e3), T, xyz


def test_the_gradient_is_that_of_the_cost():
    bundle, T, xyz = _bundle(0)
    bundle = replace(bundle, cauchy_sigmas=1.5)
    linear, slopes = bundle.linearise((T, xyz)), []
    for axis in 1e-6 * np.eye(9):
        poses, costs = T.copy(), []
        for way in (-1, 1):
            poses[1] = T[1] @ as_transform(way * axis[:6])
            points = xyz + way * np.outer(np.arange(15) == 4, axis[6:])
            costs.append(bundle.cost((poses, points)))
        slopes.append((costs[1] - costs[0]) / 2e-6)
    of_edge = linear.graph[1][0][6:]
    ours = 2 * np.concatenate([linear.g_node[1] + of_edge, linear.g_point[4]])
    assert ours == pytest.approx(slopes, rel=1e-4, abs=1e-3)


def test_errors_are_as_large_as_the_equations_say():
    """Mean chi-square of the free poses, 12 unknowns in each of 30 draws: 1 ± 4 · √(2 / 360)."""
    chi2 = []
    for seed in range(30):
        bundle, T, _ = _bundle(seed)
        poses, points = bundle.fit(T)
        linear, rows = bundle.linearise((poses, points)), slice(6, 18)
        S = np.zeros((18, 18))
        for k in range(3):
            S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = linear.H_node[k]
        S[:12, :12] += linear.graph[0][0]
        cross = np.zeros((18, 15, 3))
        for m, (n, p) in enumerate(zip(bundle.seen.node, bundle.seen.point, strict=True)):
            cross[6 * n : 6 * n + 6, p] = linear.H_cross[m]
        S -= np.einsum("ipa,pab,jpb->ij", cross, np.linalg.inv(linear.H_point), cross)
        off = np.concatenate([as_step(invert(poses[k]) @ T[k]) for k in (1, 2)])
        chi2.append(off @ S[rows, rows] @ off / 12)
    assert np.mean(chi2) == pytest.approx(1.0, abs=4 * math.sqrt(2 / 360))
