"""The pose graph's weights and steps mean what the adapter says."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import ShapeError
from recon.core.geometry import se3
from recon.places.fixes import PoseEdge, optimise_poses

STIFF = np.diag([1e8] * 6)
SOFT = np.diag([4.0, 4.0, 4.0, 9.0, 9.0, 9.0])


def _ahead(metres: float) -> np.ndarray:
    return se3.make_transform(np.eye(3), np.array([0.0, 0.0, metres]))


def test_two_edges_meet_where_their_information_says():
    edges = [
        PoseEdge(0, 1, _ahead(1.0), np.diag([3.0] * 6)),
        PoseEdge(0, 1, _ahead(2.0), np.diag([1.0] * 6)),
    ]

    poses, _ = optimise_poses(np.stack([np.eye(4), _ahead(1.0)]), edges, 1.0)
    assert poses[1][:3, 3] == pytest.approx([0.0, 0.0, 1.25], abs=1e-4)
    assert np.array_equal(poses[0], np.eye(4))


@pytest.mark.parametrize("axis", range(6))
def test_information_counts_in_its_own_direction(axis):
    """One edge knows one direction well, the other one all directions equally."""
    step = np.zeros(6)
    step[axis] = 0.01
    moved = se3.make_transform(se3.exp_so3(step[3:]), step[:3])
    sure = np.ones(6)
    sure[axis] = 1e6
    edges = [
        PoseEdge(0, 1, moved, np.diag(sure)),
        PoseEdge(0, 1, np.eye(4), np.diag([1.0] * 6)),
    ]

    poses, _ = optimise_poses(np.stack([np.eye(4), np.eye(4)]), edges, 1.0)
    got = np.concatenate([poses[1][:3, 3], se3.log_so3(poses[1][:3, :3])])
    assert got == pytest.approx(step, abs=1e-4)


@pytest.mark.parametrize("chi2", [4.0, 25.0, 400.0])
def test_a_doubtful_edge_of_that_misfit_counts_a_quarter(chi2):
    """The stiff edge holds the node 1 m from where the doubtful one wants it."""
    edges = [
        PoseEdge(0, 1, np.eye(4), STIFF),
        PoseEdge(0, 1, _ahead(1.0), np.diag([chi2] * 6), doubtful=True),
    ]

    _, weights = optimise_poses(np.stack([np.eye(4), np.eye(4)]), edges, chi2)
    assert weights[1] == pytest.approx(0.25, abs=0.01)
    assert weights[0] == 1.0


def test_an_edge_has_to_be_a_pose():
    with pytest.raises(ShapeError, match="T_first_last"):
        PoseEdge(0, 1, np.eye(3), SOFT)
