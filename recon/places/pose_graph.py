"""Pose graphs: poses that agree as well as can be with motions measured between them.

**What is off.** An edge measured ``Z = T_first_last``; of poses ``X`` it says that ``E = Z⁻¹ T``,
with ``T = X_first⁻¹ X_last``, should be the identity. What is off is the step ``e`` of ``E``: its
translation ``t`` and rotation vector ``φ``, in the axes of the later node as measured. Its
chi-square is ``eᵀ Ω e``, with the information ``Ω`` of the edge.

**Derivatives.** A pose moves by a step in its own axes, ``X ← X D(v, w)``: ``v`` its translation,
``exp w`` its rotation. If the later pose moves, ``E`` becomes ``E D``, so that ``t`` changes by
``R_E v`` and ``φ`` by ``Jr⁻¹(φ) w``. If the earlier one moves, ``E`` becomes ``E (T⁻¹ D⁻¹ T)``, the
opposite motion in the axes of the later node, which the adjoint gives:

    J_last = diag(R_E, Jr⁻¹(φ)),    J_first = −J_last Ad(T⁻¹),
    Jr⁻¹(φ) = I + ½ φ× + (1 − ½θ cot ½θ) / θ² (φ×)²,    θ = |φ|.

**Doubtful edges.** They cost ``h χ² / (h + χ²)`` instead of ``χ²`` (Geman and McClure), which is
what a switch on the edge costs where it is best set. Its slope is the weight ``(1 + χ²/h)⁻²``, a
quarter at ``χ² = h``.

**Measured positions**, by GNSS or a total station, are edges from one more node, the survey.

**Solution.** Levenberg-Marquardt: a node has edges to few others, so the normal equations are
sparse, and their factors nearly so.

Ref: Barfoot, "State estimation for robotics", 2017, section 7.1 (``Jr⁻¹``, adjoint). Choi, Zhou,
Koltun, "Robust reconstruction of indoor scenes", CVPR 2015 (switches).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from recon.core.errors import RegistrationError, ShapeError
from recon.core.geometry.alignment import Problem, minimise
from recon.core.geometry.se3 import adjoint, hat, invert, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64, Int32, freeze, frozen_array

_ROUNDS: Final = 30
_STILL: Final = 1e-6  # gain of a step, as a fraction of the cost, that is not worth another one
_DAMPING: Final = 1e-9
"""The first, of the diagonal: far below the ratio by which a chain of thousands resists
deformation."""


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """Relative pose constraint between two nodes."""

    first: int  # index of one node
    last: int  # index of the other node
    T_first_last: Float64  # (4, 4)
    # float64 (6, 6), information matrix of a step (translation in metres, rotation vector in
    # radians)
    information: Float64
    doubtful: bool = False  # whether the edge may be an outlier, which the optimiser may switch off

    def __post_init__(self) -> None:
        freeze(self, "T_first_last", np.float64, (4, 4))
        freeze(self, "information", np.float64, (6, 6))


def optimise_poses(
    T_world_node: Float64, edges: Sequence[PoseEdge], half_chi2: float, anchor: int = 0
) -> tuple[Float64, Float64]:
    """Optimise a pose graph of which one node, the ``anchor``, is fixed.

    Returns the poses (N, 4, 4), and the weight (E,) of each edge. ``half_chi2`` is the misfit at
    which that of a doubtful edge has dropped to a quarter. Nodes that no path of edges links to the
    anchor keep their place: of each such part, its first node is fixed.

    Raises:
        RegistrationError: The graph has no finite solution.
    """
    graph = PoseGraph.of(edges, half_chi2, len(T_world_node), anchor)
    if not np.isfinite(graph.cost(T_world_node)):
        raise RegistrationError("the pose graph has no solution")
    problem = Problem(graph.cost, graph.linearise, graph.step)
    poses = minimise(problem, T_world_node, rounds=_ROUNDS, min_gain=_STILL, damping=_DAMPING)
    return poses, graph.weights(poses)


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """The edges of a graph, in arrays."""

    free: Bool  # (N,), nodes that are not fixed
    ends: NDArray[np.intp]  # (E, 2), first and last node of each edge
    T_last_first: Float64  # (E, 4, 4), inverse of the measured motion
    information: Float64  # (E, 6, 6)
    half_chi2: Float64  # (E,), infinite where an edge is not doubtful

    @classmethod
    def of(
        cls, edges: Sequence[PoseEdge], half_chi2: float, count: int, anchor: int = 0
    ) -> PoseGraph:
        """Return the graph of some edges between so many nodes, of which one is fixed."""
        ends = np.array([(edge.first, edge.last) for edge in edges], np.intp).reshape(-1, 2)
        return cls(
            free_nodes(ends, count, anchor),
            ends,
            invert(np.array([edge.T_first_last for edge in edges]).reshape(-1, 4, 4)),
            np.array([edge.information for edge in edges]).reshape(-1, 6, 6),
            np.array([half_chi2 if edge.doubtful else np.inf for edge in edges]),
        )

    def weights(self, T_world_node: Float64) -> Float64:
        """Return the weight of each edge, (E,): 1 unless it is doubtful."""
        return self._weights(self._misfits(T_world_node)[1])

    def cost(self, T_world_node: Float64) -> float:
        """Return the sum of chi-square, of doubtful edges what is left of it."""
        _, chi2 = self._misfits(T_world_node)
        return float(np.sum(chi2 / (1.0 + chi2 / self.half_chi2)))

    def linearise(self, T_world_node: Float64) -> tuple[Float64, Float64]:
        """Return normal matrix (E, 12, 12) and half the gradient (E, 12) of each edge.

        The 12 are steps of its first and of its last node.
        """
        T = self._motions(T_world_node)
        steps, chi2 = self._misfits(T_world_node)
        J_last = np.zeros((len(T), 6, 6))
        J_last[:, :3, :3] = (self.T_last_first @ T)[:, :3, :3]
        # ``Jr⁻¹`` of the rotation vectors; below the least angle the factor is 1/12.
        angle = np.maximum(np.linalg.norm(steps[:, 3:], axis=1), 1e-4)
        factor = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
        K = hat(steps[:, 3:])
        J_last[:, 3:, 3:] = np.eye(3) + 0.5 * K + factor[:, None, None] * (K @ K)
        J = np.concatenate([-J_last @ adjoint(invert(T)), J_last], axis=2)
        weighted = self._weights(chi2)[:, None, None] * self.information @ J
        return np.swapaxes(weighted, 1, 2) @ J, np.einsum("eij,ei->ej", weighted, steps)

    def step(
        self, T_world_node: Float64, linear: tuple[Float64, Float64], damping: float
    ) -> Float64 | None:
        """Return poses after a step; None where the damped equations have no solution."""
        found = solve_damped(*self.equations(linear), damping)
        return None if found is None else self.moved(T_world_node, -found)

    def equations(self, linear: tuple[Float64, Float64]) -> tuple[csc_array, Float64]:
        """Return the matrix (K, K) and half the gradient (K,) of the steps of all free nodes."""
        return self._pattern.equations(*linear)

    def moved(self, T_world_node: Float64, found: Float64) -> Float64:
        """Return poses after steps (K,) of the free nodes."""
        steps = found.reshape(-1, 6)
        moves = np.tile(np.eye(4), (len(steps), 1, 1))
        moves[:, :3, :3] = Rotation.from_rotvec(steps[:, 3:]).as_matrix()
        moves[:, :3, 3] = steps[:, :3]
        moved = T_world_node.copy()
        moved[self.free] = moved[self.free] @ moves
        return np.asarray(moved)

    @cached_property
    def _pattern(self) -> _Pattern:
        return _Pattern.of(self.ends, self.free)

    def _motions(self, T_world_node: Float64) -> Float64:
        """``T_first_last`` (E, 4, 4) of the poses."""
        first, last = T_world_node[self.ends.T]
        return np.asarray(invert(first) @ last)

    def _misfits(self, T_world_node: Float64) -> tuple[Float64, Float64]:
        """What is off, as steps (E, 6), and its chi-square (E,)."""
        off = self.T_last_first @ self._motions(T_world_node)
        turns = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
        steps = np.concatenate([off[:, :3, 3], turns], axis=1)
        return steps, np.einsum("ei,eij,ej->e", steps, self.information, steps)

    def _weights(self, chi2: Float64) -> Float64:
        return np.asarray((1.0 + chi2 / self.half_chi2) ** -2)


@dataclass(frozen=True, eq=False)
class _Pattern:
    """Where the equations of edges stand in those of the whole graph, column after column."""

    indices: NDArray[np.intp]  # (M,), row of each entry
    indptr: NDArray[np.intp]  # (K + 1,), first entry of each column
    kept: Bool  # (E, 12, 12), entries of edges that concern no fixed node
    slots: NDArray[np.intp]  # the entry to which each kept one belongs
    unknowns: NDArray[np.intp]  # (E, 12), K where the node is fixed

    @classmethod
    def of(cls, ends: NDArray[np.intp], free: Bool) -> _Pattern:
        """Return the pattern of edges (E, 2) between nodes (N,)."""
        size = 6 * int(free.sum())
        number = np.where(free, 6 * np.cumsum(free) - 6, size)
        unknowns = np.minimum(number[ends][:, :, None] + np.arange(6), size).reshape(-1, 12)
        rows, columns = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
        kept = np.maximum(rows, columns) < size
        entries, slots = np.unique(columns[kept] * size + rows[kept], return_inverse=True)
        indptr = np.searchsorted(entries, size * np.arange(size + 1))
        return cls(entries % max(size, 1), indptr, kept, slots, unknowns)

    def equations(self, normal: Float64, gradient: Float64) -> tuple[csc_array, Float64]:
        """Return the equations (K, K) and (K,) of the graph from those of its edges."""
        size = len(self.indptr) - 1
        right = np.bincount(self.unknowns.ravel(), gradient.ravel(), size + 1)[:size]
        values = np.bincount(self.slots, normal[self.kept], len(self.indices))
        matrix = csc_array((values, self.indices, self.indptr), shape=(size, size))
        return matrix, np.asarray(right, np.float64)


def free_nodes(ends: NDArray[np.intp], count: int, anchor: int) -> Bool:
    """Return bool (N,), all nodes but the anchor, and but the first of each part without it.

    Parts are what edges (E, 2) hold together.
    """
    links = coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(count, count))
    _, part = connected_components(links, directed=False)
    fixed = np.unique(part, return_index=True)[1]
    fixed[part[anchor]] = anchor
    free = np.ones(count, np.bool_)
    free[fixed] = False
    return free


def solve_damped(matrix: csc_array, right: Float64, damping: float) -> Float64 | None:
    """Solve sparse, symmetric equations (K, K) with a raised diagonal; None = no solution."""
    if not len(right):
        return None
    diagonal = matrix.diagonal()
    # A direction of which nothing is known stays as it is.
    matrix.setdiag(diagonal + np.where(diagonal > 0.0, damping * diagonal, 1.0))
    try:
        factors = splu(
            matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError:  # singular
        return None
    return np.asarray(factors.solve(right))


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
            # The node nearest to each measurement, and where that was in the node's axes.
            near = np.searchsorted((own[1:] + own[:-1]) / 2, fixes.frames)
            T_node_world = invert(path.T_world_camera[own[near]])
            offset_m = _placed(T_node_world, fixes.by_path(path))
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
