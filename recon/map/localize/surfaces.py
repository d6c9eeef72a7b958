"""A local map as surfaces, and what points near them determine of a pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.core.geometry.se3 import step_jacobian
from recon.core.kernels.voxels import pack_keys
from recon.core.values.arrays import Bool, Float64, Int64

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
    information = _thin_information(covariance, edge_m)
    information[count < MIN_POINTS] = 0.0
    return Surfaces(edge_m, keys, means, information)


def fit_surfaces(xyz: Float64, surfaces: Surfaces) -> Fit:
    """Return how points (N, 3), in the axes of the surfaces, fit them."""
    cell, hit = _look_up(xyz, surfaces)
    overlap = float(hit.mean()) if len(hit) else 0.0
    flat = np.flatnonzero(hit)[surfaces.information[cell[hit]].any(axis=(1, 2))]
    if not len(flat):
        return Fit(overlap, float("nan"), np.zeros((6, 6)), surfaces.edge_m)
    near, information = xyz[flat], surfaces.information[cell[flat]]
    off = near - surfaces.means[cell[flat]]
    residual_m = float(np.median(_distance_m(off, information)))
    J = step_jacobian(near)
    total = np.einsum("nki,nkl,nlj->ij", J, information, J, optimize=True)
    return Fit(overlap, residual_m, total, surfaces.edge_m)


def misfit(xyz: Float64, surfaces: Surfaces) -> float:
    """Return how badly points (N, 3) fit: squared distances in standard deviations, summed up."""
    cell, hit = _look_up(xyz, surfaces)
    off, information = xyz[hit] - surfaces.means[cell[hit]], surfaces.information[cell[hit]]
    square = np.einsum("ni,nij,nj->n", off, information, off, optimize=True)
    square[~information.any(axis=(1, 2))] = FAR_CHI2
    return float(np.minimum(square, FAR_CHI2).sum()) + FAR_CHI2 * float((~hit).sum())


def _thin_information(covariance: Float64, edge_m: float) -> Float64:
    """Return the inverse covariance (M, 3, 3) along the thin axes, zero along the others."""
    spread, axes = np.linalg.eigh(covariance)
    thin = np.sqrt(np.maximum(spread, 0.0)) < THIN_RATIO * edge_m
    strength = np.where(thin, 1.0 / (np.maximum(spread, 0.0) + (NOISE * edge_m) ** 2), 0.0)
    information: Float64 = np.einsum("mik,mk,mjk->mij", axes, strength, axes)
    return information


def _distance_m(off: Float64, information: Float64) -> Float64:
    """Return distances (N,) along the thin axes: Mahalanobis distances, scaled to metres."""
    square = np.einsum("ni,nij,nj->n", off, information, off)
    strength = np.einsum("nii->n", information)
    distance: Float64 = np.sqrt(np.maximum(square, 0.0) / strength)
    return distance


def _look_up(xyz: Float64, surfaces: Surfaces) -> tuple[Int64, Bool]:
    """Return the index of the cell of each point, and whether there is one."""
    if not len(surfaces.keys):
        return np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.bool_)
    keys = _keys(xyz, surfaces.edge_m)
    cell = np.minimum(np.searchsorted(surfaces.keys, keys), len(surfaces.keys) - 1)
    return cell, surfaces.keys[cell] == keys


def _keys(xyz: Float64, edge_m: float) -> Int64:
    return pack_keys(np.floor(xyz / edge_m).astype(np.int64))


def _sums(cell: Int64, values: Float64, cells: int) -> Float64:
    """Sum of the rows of ``values`` in each cell."""
    columns = [np.bincount(cell, weights=column, minlength=cells) for column in values.T]
    return np.stack(columns, axis=1)
