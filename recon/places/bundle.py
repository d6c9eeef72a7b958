"""Bundle adjustment of the nodes of a pose graph and of the points that they see.

To what the edges of the graph cost comes, of each sighting of a point, ``c² log(1 + r²/c²)``, with
``r`` the difference of its column, row and disparity in standard deviations (Cauchy's loss). Their
normal equations are those of the window of visual odometry (`recon.odometry.kernels.bundle`), node
after node. The points are eliminated (Schur complement): what is left is sparse, since few nodes
see the same points. A sighting takes about 1 kB.

Ref: Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csc_array

from recon.core.geometry.alignment import Problem, minimise
from recon.core.geometry.se3 import invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.core.values.camera import project
from recon.odometry.kernels import bundle
from recon.places.keyframe import points_of
from recon.places.pose_graph import PoseGraph, solve_damped

_ROUNDS: Final = 12
_STILL: Final = 1e-4  # gain of a step, as a fraction of the cost, that is not worth another one
_OF_MEDIAN: Final = 1.4826  # standard deviations of a normal error in a median absolute one
_LEAST_PX: Final = 0.05  # however well features fit, they count as no better

State: TypeAlias = tuple[Float64, Float64]
"""Poses (N, 4, 4) of the nodes, and points (P, 3), in the world."""

_OneFrame: TypeAlias = tuple[Float64, Float64, Float64]
"""``T_camera_world``, what is seen, and points, as the kernel takes them."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Where nodes see points: in order of the nodes, each of which sees a point once."""

    node: NDArray[np.intp]  # (M,), ascending
    point: NDArray[np.intp]  # (M,), every number below P at least once
    uvd: Float64  # (M, 3), column, row, disparity

    @property
    def points(self) -> int:
        """Number of points, P."""
        return int(self.point.max(initial=-1)) + 1

    def of_points(self, chosen: Bool) -> Sightings:
        """Return those of some points (P,), numbered anew."""
        kept, number = chosen[self.point], np.cumsum(chosen) - 1
        return Sightings(self.node[kept], number[self.point[kept]], self.uvd[kept])

    def by_node(self) -> Iterator[tuple[int, slice]]:
        """Yield the nodes that see anything, and which sightings are theirs."""
        nodes, begins = np.unique(self.node, return_index=True)
        ends = [*begins[1:].tolist(), len(self.node)]
        for node, begin, end in zip(nodes.tolist(), begins.tolist(), ends, strict=True):
            yield node, slice(begin, end)


class _Linear(NamedTuple):
    """Normal equations: of the graph, nodes (N), points (P), and of both by sighting (M)."""

    graph: tuple[Float64, Float64]
    H_node: Float64  # (N, 6, 6)
    g_node: Float64  # (N, 6)
    H_point: Float64  # (P, 3, 3)
    g_point: Float64  # (P, 3)
    H_cross: Float64  # (M, 6, 3)


@dataclass(frozen=True, eq=False)
class Bundle:
    """The nodes of a graph, what they see, and how well."""

    graph: PoseGraph
    seen: Sightings
    camera: RectifiedCamera
    sigma_px: tuple[float, float]  # standard deviations of columns and rows, and of disparities
    cauchy_sigmas: float  # residual at which a sighting counts half

    def fit(self, T_world_node: Float64) -> State:
        """Fit the free nodes and all points, from poses."""
        problem = Problem(self.cost, self.linearise, self.step)
        start = T_world_node, self._points_at(T_world_node)
        return minimise(problem, start, rounds=_ROUNDS, min_gain=_STILL)

    def residuals_px(self, state: State) -> Float64:
        """Return predicted minus seen column, row, disparity (M, 3); NaN behind a camera."""
        T = invert(state[0])[self.seen.node]
        xyz = np.einsum("mij,mj->mi", T[:, :3, :3], state[1][self.seen.point]) + T[:, :3, 3]
        return np.stack(project(xyz, self.camera), axis=1) - self.seen.uvd

    def sightings_cost(self, state: State) -> float:
        costs = (bundle.cost(*each, tuple(self._model)) for _, _, each in self._by_node(state))
        return self.cauchy_sigmas**2 * sum(costs)

    def cost(self, state: State) -> float:
        return self.graph.cost(state[0]) + self.sightings_cost(state)

    def linearise(self, state: State) -> _Linear:
        """Return the normal equations; of gradients, half."""
        nodes, points = len(state[0]), self.seen.points
        found = _Linear(
            self.graph.linearise(state[0]),
            np.zeros((nodes, 6, 6)),
            np.zeros((nodes, 6)),
            np.zeros((points, 3, 3)),
            np.zeros((points, 3)),
            np.empty((len(self.seen.node), 6, 3)),
        )
        for node, rows, each in self._by_node(state):
            normal, seen = bundle.linearise(*each, self._model), self.seen.point[rows]
            found.H_node[node], found.g_node[node] = normal.H_pose[0], -normal.g_pose[0]
            found.H_cross[rows] = normal.H_cross[0]
            found.H_point[seen] += normal.H_point
            found.g_point[seen] -= normal.g_point
        return found

    def step(self, state: State, linear: _Linear, damping: float) -> State | None:
        """Return poses and points after a step; None where it has no solution."""
        raised = linear.H_point * (1.0 + damping * np.eye(3)) + bundle.RIDGE * np.eye(3)
        inverse = np.linalg.inv(raised)
        moved, change = state[0], np.zeros((len(inverse), 3))
        if self.graph.free.any():
            cross = self._by_free_node(linear.H_cross)
            folded = self._by_free_node(linear.H_cross @ inverse[self.seen.point])
            matrix, right = self.graph.equations(linear.graph)
            matrix = csc_array(matrix + self._diagonal(linear.H_node) - folded @ cross.T)
            right = right + linear.g_node[self.graph.free].ravel()
            found = solve_damped(matrix, right - folded @ linear.g_point.ravel(), damping)
            if found is None:
                return None
            moved, change = self.graph.moved(state[0], -found), (cross.T @ found).reshape(-1, 3)
        steps = np.einsum("pij,pj->pi", inverse, change - linear.g_point)
        return moved, state[1] + steps

    def measured(self, state: State, ratio: float) -> Bundle:
        """Return it with standard deviations as its residuals show them.

        ``ratio`` is that of the sightings whose errors count as independent.
        """
        off = np.abs(self.residuals_px(state))
        unknowns = 3 * self.seen.points + 6 * int(self.graph.free.sum())
        more = np.sqrt(off.size / max(off.size - unknowns, 1) / ratio)
        uv, d = (
            max(_OF_MEDIAN * float(np.nanmedian(part)), _LEAST_PX) * float(more)
            for part in (off[:, :2], off[:, 2])
        )
        return replace(self, sigma_px=(uv, d))

    @cached_property
    def _model(self) -> bundle.BundleModel:
        camera, (sigma_uv, sigma_d) = self.camera, self.sigma_px
        fb = camera.focal_px * camera.baseline_m
        pinhole = camera.focal_px, camera.cx_px, camera.cy_px, fb, camera.doffs_px
        return bundle.BundleModel(*pinhole, sigma_uv, sigma_d, self.cauchy_sigmas)

    def _by_node(self, state: State) -> Iterator[tuple[int, slice, _OneFrame]]:
        """Yield each node, which sightings are its, and them as a window of one frame."""
        T_node_world, xyz = invert(state[0]), state[1]
        for node, rows in self.seen.by_node():
            at, uvd = T_node_world[node : node + 1], self.seen.uvd[rows][None]
            yield node, rows, (at, uvd, xyz[self.seen.point[rows]])

    def _points_at(self, T_world_node: Float64) -> Float64:
        """Return each point where the node that is nearest to it sees it."""
        order = np.lexsort((-self.seen.uvd[:, 2], self.seen.point))
        rows = order[np.unique(self.seen.point[order], return_index=True)[1]]
        T, xyz = T_world_node[self.seen.node[rows]], points_of(self.seen.uvd[rows], self.camera)
        return np.asarray(np.einsum("pij,pj->pi", T[:, :3, :3], xyz) + T[:, :3, 3])

    def _by_free_node(self, blocks: Float64) -> bsr_array:
        """Return blocks (M, 6, 3) of sightings as a matrix, without the rows of fixed nodes."""
        free = self.graph.free
        kept, number = free[self.seen.node], np.cumsum(free) - 1
        begins = np.searchsorted(number[self.seen.node[kept]], np.arange(free.sum() + 1))
        shape = (6 * int(free.sum()), 3 * self.seen.points)
        return bsr_array((blocks[kept], self.seen.point[kept], begins), shape=shape)

    def _diagonal(self, blocks: Float64) -> bsr_array:
        """Return blocks (N, 6, 6) of the free nodes along the diagonal of a matrix."""
        chosen = blocks[self.graph.free]
        places = np.arange(len(chosen) + 1)
        return bsr_array((chosen, places[:-1], places), shape=(6 * len(chosen),) * 2)
