"""The surfaces of a map around a pose, and whether a correction by ICP to them is worth applying.

It is if it fits better, is likely, and knows more; and if the surfaces could have refused it: in a
street they fit as well half a metre on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import (
    adjoint,
    apply,
    as_step,
    as_transform,
    covariance_of,
    distance_in_sigmas,
    invert,
    step_covariance,
    step_jacobian,
)
from recon.core.kernels.voxels import find_keys, pack_keys
from recon.core.values.arrays import Float64, Int64
from recon.io.files import reading
from recon.map.localize.belief import MAX_SIGMA_DEG, MAX_SIGMA_M, Belief
from recon.map.store.map_file import MapFile
from recon.map.store.session import Session
from recon.odometry.guide import MAX_SIGMAS
from recon.odometry.kiss import IcpAlignment, KissIcp, select_points
from recon.odometry.protocol import OdometryFrame
from recon.places.places import SIGMAS

# Lengths are those on a road: they are times the scale of the map.
_VOXEL_M: Final = 0.3  # edge of a voxel of the map of ICP
_THRESHOLD_M: Final = 0.3  # points pair up to thrice as far
_KERNEL_M2: Final = 0.3  # squared distance at which a pair counts a quarter
_STILL: Final = 1e-3  # step of ICP that is its last one
_SURFACE_M: Final = 1.0  # edge of the cells in which surfaces are fitted to the map
_RELOAD_M: Final = 10.0  # way after which the points around the camera are read again
_MIN_POINTS: Final = 300  # frames with fewer points are not corrected
_OFFSET_FRAMES: Final = 30
"""Corrections of poses that features confirm are averaged over as many frames and subtracted: their
mean is the bias of stereo depth, not an error of the pose."""
_ASIDE: Final = SIGMAS * np.repeat([MAX_SIGMA_M / _SURFACE_M, np.deg2rad(MAX_SIGMA_DEG)], 3)
"""Steps, in edges of cells and radians, along and about each axis to poses that no pose given out
may be mistaken for."""


@dataclass(frozen=True, eq=False)
class _Part:
    """A submap, and from where it was seen.

    ``T_map_submap`` is from the world of the odometry to that of the map; ``cameras_m`` (N, 3),
    where its frames were taken, in the world of the map.
    """

    session: Session
    index: int
    T_map_submap: Float64
    cameras_m: Float64

    def points(self) -> Float64:
        """Return float64 (M, 3), the fused points in the world of the map."""
        with reading(self.session.where):
            fusion = self.session.info.config["fusion"]
            voxel_m, least = float(fusion["voxel_m"]), int(fusion["min_count"])
        fused = self.session.submaps[self.index].fused
        cloud = fused.cloud(voxel_m, min(least, len(self.session)))
        return apply(self.T_map_submap, cloud.xyz.astype(np.float64))


class Surroundings:
    """The fused points of a map around a camera, up to a range, as a map for kiss-icp."""

    def __init__(self, map_: MapFile, max_range_m: float) -> None:
        self._range_m = max_range_m
        self._parts = [part for session in map_.linked for part in _parts(map_, session)]
        self._scale = scale = map_.first.scale
        voxel_m, still = scale * _VOXEL_M, scale * _STILL
        self._icp = KissIcp(max_range_m, voxel_m, iterations=50, convergence=still)
        self._loaded_at = np.full(3, np.inf)
        self._surfaces = describe_surfaces(np.zeros((0, 3)), scale * _SURFACE_M)
        self._offset = np.zeros(6)
        self._measured = 0

    def correct(self, belief: Belief, frame: OdometryFrame, *, learn: bool) -> Belief | None:
        """Return a belief corrected by the surfaces around it; None where they say nothing.

        From a frame to ``learn`` from, the bias of the correction is learnt.
        """
        points = select_points(frame, self._range_m)
        if len(points) < _MIN_POINTS:
            return None
        T_prior = belief.T_world_camera
        alignment = self.align(points.xyz.astype(np.float64), T_prior)
        T_icp, source = alignment.T_world_camera, alignment.source
        measured = Correction(
            step=as_step(invert(T_prior) @ T_icp),
            before=_fit(source, T_prior, self._surfaces),
            after=_fit(source, T_icp, self._surfaces),
            contrast=contrast(source, T_icp, self._surfaces),
        )
        correction = replace(measured, step=measured.step - self._offset)
        if learn:
            self._measured += 1
            ratio = 1.0 / min(self._measured, _OFFSET_FRAMES)
            self._offset = (1.0 - ratio) * self._offset + ratio * measured.step
        if not is_worthwhile(correction, belief.covariance):
            return None
        T = T_prior @ as_transform(correction.step)
        return belief.corrected_to(T, icp_covariance(correction.after))

    def align(self, xyz: Float64, T_world_guess: Float64) -> IcpAlignment:
        """Return kiss-icp's pose of a frame with points (N, 3) in the map, from a guess."""
        self._load(T_world_guess[:3, 3])
        limits = self._scale * _THRESHOLD_M, self._scale**2 * _KERNEL_M2
        return self._icp.align(xyz, T_world_guess, *limits)

    def _load(self, camera_m: Float64) -> None:
        """Take the points around a position into the map of ICP, unless they are there."""
        reload_m = self._scale * _RELOAD_M
        if np.linalg.norm(camera_m - self._loaded_at) <= reload_m:
            return
        self._loaded_at = np.array(camera_m)
        reach_m = self._range_m + reload_m
        near = [
            part
            for part in self._parts
            if np.linalg.norm(part.cameras_m - camera_m, axis=1).min(initial=np.inf) <= reach_m
        ]
        xyz = np.concatenate([np.zeros((0, 3)), *(part.points() for part in near)])
        xyz = xyz[np.linalg.norm(xyz - camera_m, axis=1) <= reach_m]
        self._icp.set_map(xyz)
        self._surfaces = describe_surfaces(xyz, self._scale * _SURFACE_M)


def contrast(xyz_camera: Float64, T_world_camera: Float64, surfaces: Surfaces) -> float:
    """Return by how much poses around another one fit worse, in chi-square; of the best of them.

    Surfaces that fit half a metre away, too, say nothing of a pose, however well they fit there.
    """
    aside = _ASIDE * np.repeat([surfaces.edge_m, 1.0], 3)
    steps = np.concatenate([np.diag(aside), np.diag(-aside)])
    around = [T_world_camera @ as_transform(step) for step in steps]
    here, *there = (misfit(apply(T, xyz_camera), surfaces) for T in (T_world_camera, *around))
    return min(there) - here


def _parts(map_: MapFile, session: Session) -> Iterator[_Part]:
    apart = session.trusted & ~map_.placed[session.number]
    corrections, T_map_session = session.corrections(), map_.T_world_session(session)
    cameras_m = apply(T_map_session, session.trajectory.positions_m)
    for entry in session.submaps.entries:
        frames = slice(entry.first_frame, entry.first_frame + entry.frames)
        if apart[frames].any():
            continue
        T = T_map_session if corrections is None else T_map_session @ corrections[entry.index]
        yield _Part(session, entry.index, T, cameras_m[frames])


def _fit(xyz_camera: Float64, T_world_camera: Float64, surfaces: Surfaces) -> Fit:
    """Return how points of a frame fit; the information is that of a step in camera axes."""
    fit = fit_surfaces(apply(T_world_camera, xyz_camera), surfaces)
    turn = adjoint(T_world_camera)
    return replace(fit, information=turn.T @ fit.information @ turn)


_MIN_OVERLAP: Final = 0.5  # least fraction of points that lie in a cell of the map
_MIN_RESIDUAL_GAIN: Final = 0.02  # least relative decrease of the median residual
_MIN_RATIO: Final = 0.1
"""Least Kalman gain, in the direction in which it is largest: with less, ICP knows no more than the
prior."""
_ICP_INDEPENDENCE: Final = 0.05  # fraction of the points whose errors count as independent
_MIN_CONTRAST: Final = 2.0 * math.log(1000.0)
"""Chi-square by which any pose that is wrong must fit worse: it is a thousand times less likely."""
_ICP_FLOOR: Final = 0.02
"""Standard deviation of ICP's translation, in edges of cells, that more points do not improve."""
_ICP_FLOOR_DEG: Final = 0.05  # that of its rotation


@dataclass(frozen=True, eq=False)
class Correction:
    """How ICP would move the prior, and how the frame fits the map before and after.

    ``step``, float64 (6,), is a translation in metres and a rotation vector in radians, in camera
    axes of the prior, without the bias that all corrections share. ``contrast`` is by how much the
    poses around ICP's fit worse.
    """

    step: Float64
    before: Fit
    after: Fit
    contrast: float


def is_worthwhile(correction: Correction, prior_covariance: Float64) -> bool:
    """Return whether ICP improves on its prior, of which (6, 6) is the covariance of a step."""
    before, after, step = correction.before, correction.after, correction.step
    # A residual that is not known compares as False.
    if not after.residual_m <= (1.0 - _MIN_RESIDUAL_GAIN) * before.residual_m:
        return False
    if _ICP_INDEPENDENCE * correction.contrast < _MIN_CONTRAST:
        return False
    both = prior_covariance + icp_covariance(after)
    likely = distance_in_sigmas(step, both) <= MAX_SIGMAS
    # Whitened by `both = L·Lᵀ`, the Kalman gain `prior·both⁻¹` is symmetric.
    L = np.linalg.cholesky(both)
    white = np.linalg.solve(L, np.linalg.solve(L, prior_covariance).T)
    gain = float(np.linalg.eigvalsh(white)[-1])
    return after.overlap >= _MIN_OVERLAP and likely and gain >= _MIN_RATIO


def icp_covariance(fit: Fit) -> Float64:
    """Return the covariance (6, 6) of ICP: from the surfaces that fix it, at least their bias."""
    floor = step_covariance(_ICP_FLOOR * fit.edge_m, _ICP_FLOOR_DEG)
    return covariance_of(_ICP_INDEPENDENCE * fit.information) + floor


MIN_POINTS = 10  # least number of points in a cell with a surface
THIN_RATIO = 0.1
"""A cell is thin along an axis where its points spread by less than this fraction of its edge.

Points that fill a cell evenly spread by 0.29 of its edge (1/√12)."""
NOISE = (
    0.02  # standard deviation that is added to that of every surface, as a fraction of that edge
)
FAR_CHI2 = 9.0
"""Points three standard deviations from the surface of their cell count like those without one."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Cells of a map, each with its mean and its surface."""

    edge_m: float  # edge of a cell
    keys: Int64  # int64 (M,), packed cell indices, ascending
    means: Float64  # (M, 3), mean of the points in each cell
    # float64 (M, 3, 3), inverse covariance along the thin axes, zero along the others: a wall fixes
    # one direction, a pole two, a bush none
    information: Float64


@dataclass(frozen=True, eq=False)
class Fit:
    """How points fit surfaces."""

    overlap: float  # fraction of points that lie in a cell of the map
    residual_m: float  # median distance of points to the surface of their cell; NaN = no surface
    # float64 (6, 6), of a step (translation in metres, rotation vector in radians) of their frame
    information: Float64
    edge_m: float = 1.0  # edge of the cells


def describe_surfaces(xyz: Float64, edge_m: float) -> Surfaces:
    """Fit a surface to the points in each cell of a cloud (N, 3).

    Ref: Biber and Straßer, "The normal distributions transform", IROS 2003.
    """
    keys, cell, count = np.unique(_keys(xyz, edge_m), return_inverse=True, return_counts=True)
    means = _sums(cell, xyz, len(keys)) / count[:, None]
    off = xyz - means[cell]
    products = np.einsum("ni,nj->nij", off, off).reshape(-1, 9)
    covariance = _sums(cell, products, len(keys)).reshape(-1, 3, 3) / count[:, None, None]
    spread, axes = np.linalg.eigh(covariance)
    thin = np.sqrt(np.maximum(spread, 0.0)) < THIN_RATIO * edge_m
    strength = np.where(thin, 1.0 / (np.maximum(spread, 0.0) + (NOISE * edge_m) ** 2), 0.0)
    information: Float64 = np.einsum("mik,mk,mjk->mij", axes, strength, axes)
    information[count < MIN_POINTS] = 0.0
    return Surfaces(edge_m, keys, means, information)


def fit_surfaces(xyz: Float64, surfaces: Surfaces) -> Fit:
    """Return how points (N, 3), in the axes of the surfaces, fit them."""
    cell, hit = find_keys(_keys(xyz, surfaces.edge_m), surfaces.keys)
    overlap = float(hit.mean()) if len(hit) else 0.0
    flat = np.flatnonzero(hit)[surfaces.information[cell[hit]].any(axis=(1, 2))]
    if not len(flat):
        return Fit(overlap, float("nan"), np.zeros((6, 6)), surfaces.edge_m)
    near, information = xyz[flat], surfaces.information[cell[flat]]
    off = near - surfaces.means[cell[flat]]
    # Distances along the thin axes: Mahalanobis distances, scaled to metres.
    square = np.einsum("ni,nij,nj->n", off, information, off)
    strength = np.einsum("nii->n", information)
    residual_m = float(np.median(np.sqrt(np.maximum(square, 0.0) / strength)))
    J = step_jacobian(near)
    total = np.einsum("nki,nkl,nlj->ij", J, information, J, optimize=True)
    return Fit(overlap, residual_m, total, surfaces.edge_m)


def misfit(xyz: Float64, surfaces: Surfaces) -> float:
    """Return how badly points (N, 3) fit: squared distances in standard deviations, summed up."""
    cell, hit = find_keys(_keys(xyz, surfaces.edge_m), surfaces.keys)
    off, information = xyz[hit] - surfaces.means[cell[hit]], surfaces.information[cell[hit]]
    square = np.einsum("ni,nij,nj->n", off, information, off, optimize=True)
    square[~information.any(axis=(1, 2))] = FAR_CHI2
    return float(np.minimum(square, FAR_CHI2).sum()) + FAR_CHI2 * float((~hit).sum())


def _keys(xyz: Float64, edge_m: float) -> Int64:
    return pack_keys(np.floor(xyz / edge_m).astype(np.int64))


def _sums(cell: Int64, values: Float64, cells: int) -> Float64:
    columns = [np.bincount(cell, weights=column, minlength=cells) for column in values.T]
    return np.stack(columns, axis=1)
