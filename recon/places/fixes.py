"""Positions measured along drives, by GNSS or a total station, as edges of a pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import ShapeError
from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64, Int32, frozen_array
from recon.places.pose_graph import PoseEdge

_NO_TURN: Final = 1e-9  # information of a rotation that was not measured; the optimiser needs some


@dataclass(frozen=True, eq=False)
class Fixes:
    """Where something on a vehicle was measured during a drive."""

    frames: Int32  # int32 (N,), the frame nearest to each measurement
    # float64 (N, 3), where it was then, from the camera of that frame, in its axes
    offset_m: Float64
    position_m: Float64  # (N, 3), where it was measured, in the coordinates of a survey
    sigma_m: Float64  # (N,), standard deviations of a measured coordinate

    def __post_init__(self) -> None:
        count = len(self.frames)
        frozen_array("frames", self.frames, np.int32, (count,))
        frozen_array("offset_m", self.offset_m, np.float64, (count, 3))
        frozen_array("position_m", self.position_m, np.float64, (count, 3))
        # Maps of before have one for all.
        each_m = np.broadcast_to(np.asarray(self.sigma_m, np.float64), (count,))
        object.__setattr__(self, "sigma_m", each_m)
        if not (np.isfinite(self.position_m).all() and (self.sigma_m > 0.0).all()):
            raise ShapeError("measured positions are finite, and have a standard deviation")

    def __len__(self) -> int:
        return len(self.frames)

    def by_path(self, trajectory: Trajectory) -> Float64:
        """Return where a path has what was measured: float64 (N, 3), in its world."""
        return _placed(trajectory.T_world_camera[self.frames], self.offset_m)

    def at_nodes(
        self, trajectory: Trajectory, nodes: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], Float64]:
        """Return the node nearest to each measurement, and where it was in the node's axes."""
        frames = np.searchsorted((nodes[1:] + nodes[:-1]) / 2, self.frames)
        T_node_world = invert(trajectory.T_world_camera[nodes[frames]])
        return frames, _placed(T_node_world, self.by_path(trajectory))


NO_FIXES: Final = Fixes(np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
"""Of a drive along which nothing was measured."""


@dataclass(frozen=True, eq=False)
class Held:
    """What holds drives at measured positions."""

    T_world_survey: Float64  # (4, 4), about where the coordinates of the survey are
    fixes: Sequence[Fixes]  # those of each drive, of which some may be empty

    def edges(
        self, drives: Sequence[Trajectory], nodes: Sequence[NDArray[np.intp]], T_world_node: Float64
    ) -> list[PoseEdge]:
        """An edge from the survey to each node near which something was measured.

        It says where the node is, and not how it is turned. What is near one node counts as one
        measurement, as good as its best: neighbours are off by the same. The last of the poses
        ``T_world_node`` is the survey's; an antenna beside the camera moves as it turns.
        """
        survey, begin, edges = len(T_world_node) - 1, 0, list[PoseEdge]()
        R_survey_world = T_world_node[survey, :3, :3].T
        for path, own, fixes in zip(drives, nodes, self.fixes, strict=True):
            near, offset_m = fixes.at_nodes(path, own)
            for k in np.unique(near).tolist():
                R = R_survey_world @ T_world_node[begin + k, :3, :3]
                here = near == k
                weights = fixes.sigma_m[here] ** -2
                places_m = fixes.position_m[here] - offset_m[here] @ R.T
                place_m = np.average(places_m, axis=0, weights=weights)
                information = np.diag(3 * [weights.max()] + 3 * [_NO_TURN])
                edges.append(PoseEdge(survey, begin + k, make_transform(R, place_m), information))
            begin += len(own)
        return edges


def _placed(T: Float64, offset_m: Float64) -> Float64:
    """Return offsets (N, 3) by as many transforms (N, 4, 4)."""
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], offset_m) + T[:, :3, 3])
