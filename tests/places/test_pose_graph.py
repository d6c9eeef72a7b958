"""A pose graph finds the truth, in thousands of nodes, and leaves out edges that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import RegistrationError, ShapeError
from recon.core.geometry.se3 import as_step, as_transform, invert
from recon.places.pose_graph import PoseEdge, PoseGraph, optimise_poses

STEP = as_transform(np.array([0.0, 0.0, 5.0, 0.0, 2 * np.pi / 1000, 0.0]))
ODOMETRY = np.repeat([0.03, 0.0005], 3)  # standard deviations of a step
LOOP = np.repeat([0.05, 0.002], 3)


def _ahead(metres: float) -> np.ndarray:
    return as_transform(np.array([0.0, 0.0, metres, 0.0, 0.0, 0.0]))


def _chain(steps: np.ndarray) -> np.ndarray:
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


@pytest.mark.parametrize("seed", range(4))
def test_the_gradient_is_that_of_the_cost(seed):
    """Also where edges are far off and weigh less, by finite differences in each node's axes."""
    rng = np.random.default_rng(seed)
    poses = np.stack([as_transform(step) for step in rng.normal(0.0, 1.0, (2, 6))])
    root = rng.normal(size=(6, 6))
    edge = PoseEdge(0, 1, as_transform(rng.normal(0.0, 0.4, 6)), root @ root.T, doubtful=seed > 1)
    graph = PoseGraph.of([edge], 20.0, 2)
    slopes = np.empty((2, 6))
    for node, axis in np.ndindex(slopes.shape):
        costs = []
        for way in (-1e-6, 1e-6):
            moved = poses.copy()
            moved[node] = poses[node] @ as_transform(way * np.eye(6)[axis])
            costs.append(graph.cost(moved))
        slopes[node, axis] = (costs[1] - costs[0]) / 2e-6
    gradient = 2.0 * graph.linearise(poses)[1][0]
    assert gradient == pytest.approx(slopes.ravel(), rel=1e-5, abs=1e-5 * np.abs(slopes).max())


def test_three_laps_of_a_thousand_nodes_lie_on_each_other_whatever_loops_are_wrong():
    rng = np.random.default_rng(0)
    truth = _chain(np.tile(STEP, (2999, 1, 1)))

    def measured(first: int, last: int, sigmas: np.ndarray, doubtful: bool) -> PoseEdge:
        off = as_transform(sigmas * rng.normal(size=6))
        T = invert(truth[first]) @ truth[last] @ off
        return PoseEdge(first, last, T, np.diag(sigmas**-2), doubtful)

    steps = [measured(k, k + 1, ODOMETRY, doubtful=False) for k in range(2999)]
    loops = [measured(k, k + 1000, LOOP, doubtful=True) for k in range(2000)]
    # A house 60 m on is taken for the right one.
    wrong = [
        PoseEdge(k, k + 1012, loops[k].T_first_last, loops[k].information, doubtful=True)
        for k in range(0, 1900, 20)
    ]
    start = _chain(np.stack([edge.T_first_last for edge in steps]))
    poses, weights = start, np.zeros(0)
    for tolerance in (1e4, 1e3, 22.5):
        poses, weights = optimise_poses(poses, [*steps, *loops, *wrong], tolerance)
    assert np.array_equal(poses[0], np.eye(4))
    assert (weights[: len(steps)] == 1.0).all()
    assert (weights[len(steps) : -len(wrong)] > 0.25).mean() > 0.99
    assert (weights[-len(wrong) :] < 0.01).all()
    lap = invert(poses[:2000]) @ poses[1000:]
    before = invert(start[:2000]) @ start[1000:]
    off_m, off_before_m = (np.linalg.norm(T[:, :3, 3], axis=1).max() for T in (lap, before))
    assert off_before_m > 5.0
    assert off_m < 0.2


def test_what_no_edge_holds_keeps_its_place():
    """Nodes 3 and 4 are linked to each other alone, node 5 to none, nor has 6 with itself a say."""
    poses = np.stack([_ahead(k) for k in (0.0, 1.2, 1.9, 50.0, 52.0, 70.0, 80.0)])
    ends = ((0, 1), (1, 2), (3, 4), (6, 6))
    edges = [PoseEdge(*each, _ahead(each[1] - each[0]), np.eye(6)) for each in ends]
    found, _ = optimise_poses(poses, edges, 1.0)
    assert found[:, 2, 3] == pytest.approx([0.0, 1.0, 2.0, 50.0, 51.0, 70.0, 80.0])
    assert np.array_equal(optimise_poses(poses, [], 1.0)[0], poses)


def test_a_direction_that_no_edge_measured_stays_as_it_is():
    edge = PoseEdge(0, 1, _ahead(2.0), np.diag([1.0, 0.0, 1.0, 1.0, 1.0, 1.0]))
    start = as_transform(np.array([0.0, 3.0, 1.0, 0.0, 0.0, 0.0]))
    found, _ = optimise_poses(np.stack([np.eye(4), start]), [edge], 1.0)
    assert as_step(found[1]) == pytest.approx([0.0, 3.0, 2.0, 0.0, 0.0, 0.0])


def test_two_edges_meet_where_their_information_says():
    edges = [PoseEdge(0, 1, _ahead(k), w * np.eye(6)) for k, w in ((1.0, 3.0), (2.0, 1.0))]
    poses, _ = optimise_poses(np.stack([np.eye(4), _ahead(1.0)]), edges, 1.0)
    assert poses[1][:3, 3] == pytest.approx([0.0, 0.0, 1.25], abs=1e-4)


@pytest.mark.parametrize("axis", range(6))
def test_information_counts_in_its_own_direction(axis):
    """One edge knows one direction well, the other one all directions equally."""
    step = 0.01 * np.eye(6)[axis]
    sure = 1.0 + 1e6 * np.eye(6)[axis]
    edges = [
        PoseEdge(0, 1, as_transform(step), np.diag(sure)),
        PoseEdge(0, 1, np.eye(4), np.eye(6)),
    ]
    poses, _ = optimise_poses(np.stack([np.eye(4), np.eye(4)]), edges, 1.0)
    assert as_step(poses[1]) == pytest.approx(step, abs=1e-4)


@pytest.mark.parametrize("chi2", [4.0, 25.0, 400.0])
def test_a_doubtful_edge_of_that_misfit_counts_a_quarter(chi2):
    """The stiff edge holds the node 1 m from where the doubtful one wants it."""
    edges = [
        PoseEdge(0, 1, np.eye(4), 1e8 * np.eye(6)),
        PoseEdge(0, 1, _ahead(1.0), chi2 * np.eye(6), doubtful=True),
    ]
    _, weights = optimise_poses(np.stack([np.eye(4), np.eye(4)]), edges, chi2)
    assert weights[1] == pytest.approx(0.25, abs=0.01)
    assert weights[0] == 1.0


def test_an_edge_is_a_pose_and_finite():
    with pytest.raises(ShapeError, match="T_first_last"):
        PoseEdge(0, 1, np.eye(3), np.eye(6))
    nowhere = PoseEdge(0, 1, _ahead(1.0), np.full((6, 6), np.nan))
    with pytest.raises(RegistrationError, match="no solution"):
        optimise_poses(np.stack([np.eye(4), np.eye(4)]), [nowhere], 1.0)
