"""Open3D's pose graph optimisation: arrays in, arrays out, its errors converted to ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d

from recon.core.errors import RegistrationError
from recon.core.values.arrays import Float64, freeze


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """Relative pose constraint between two nodes.

    Attributes:
        first: Index of one node.
        last: Index of the other node.
        T_first_last: float64 (4, 4).
        information: float64 (6, 6), information matrix of a step (translation in metres, rotation
            vector in radians).
        doubtful: Whether the edge may be an outlier, which the optimiser may switch off.
    """

    first: int
    last: int
    T_first_last: Float64
    information: Float64
    doubtful: bool = False

    def __post_init__(self) -> None:
        freeze(self, "T_first_last", np.float64, (4, 4))
        freeze(self, "information", np.float64, (6, 6))


def optimise_poses(
    T_world_node: Float64, edges: Sequence[PoseEdge], half_chi2: float
) -> tuple[Float64, Float64]:
    """Optimise a pose graph; the first node is fixed.

    Args:
        T_world_node: float64 (N, 4, 4), initial poses.
        edges: The constraints.
        half_chi2: Misfit at which the weight of a doubtful edge has dropped to a quarter.

    Returns:
        The poses, float64 (N, 4, 4), and the weight of each edge, float64, in [0, 1].

    Ref:
        Choi, Zhou, Koltun, "Robust reconstruction of indoor scenes", CVPR 2015.
    """
    registration = o3d.pipelines.registration
    graph = registration.PoseGraph()
    for T in T_world_node:
        graph.nodes.append(registration.PoseGraphNode(np.array(T)))
    for edge in edges:
        graph.edges.append(_edge(edge))
    # Open3D scales its line process by the mean of what it assumes to be a number of points.
    scale = float(np.mean([edge.information[2, 2] for edge in edges]))
    option = registration.GlobalOptimizationOption(
        max_correspondence_distance=1.0,
        edge_prune_threshold=0.0,
        preference_loop_closure=half_chi2 / scale,
        reference_node=0,
    )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            option,
        )
    return _poses(graph), np.array([edge.confidence for edge in graph.edges])


def _edge(edge: PoseEdge) -> Any:
    # Open3D's steps begin with the rotation, ours with the translation.
    order = [3, 4, 5, 0, 1, 2]
    information = np.array(edge.information)[np.ix_(order, order)]
    return o3d.pipelines.registration.PoseGraphEdge(
        edge.last, edge.first, np.array(edge.T_first_last), information, edge.doubtful
    )


def _poses(graph: Any) -> Float64:
    poses = np.array([node.pose for node in graph.nodes])
    if not np.isfinite(poses).all():
        raise RegistrationError("the pose graph has no solution")
    return poses
