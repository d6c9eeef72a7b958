"""The twin of `recon.map.kernels.facets`: points in a dictionary, one cell at a time."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.map.kernels.facets import LEAST
from tests.core.kernels.voxels_reference import Cell


def crossed_cells_reference(
    cells: list[Cell], points: dict[Cell, tuple[float, NDArray[Any]]]
) -> list[bool]:
    """Which cells are crossed, as `recon.map.kernels.facets.crossed_cells` defines it.

    Args:
        cells: The cells asked about.
        points: Of each cell that holds points, the sum of their weights and their mean, float64
            (3,), as a place in space.
    """
    return [_crossed(cell, points) for cell in cells]


def _crossed(cell: Cell, points: dict[Cell, tuple[float, NDArray[Any]]]) -> bool:
    """Whether the surface crosses one cell."""
    steps = product((-1, 0, 1), repeat=3)
    around = [points.get((cell[0] + i, cell[1] + j, cell[2] + k)) for i, j, k in steps]
    known = [point for point in around if point is not None]
    if len(known) < LEAST:
        return cell in points
    weights = np.array([weight for weight, _ in known])
    places = np.array([place for _, place in known]) - (np.array(cell) + 0.5)
    spread = np.cov(places.T, aweights=weights, ddof=0)
    normal = np.linalg.eigh(spread)[1][:, 0]
    along = places @ normal
    beside = (places**2).sum(axis=1) - along**2
    distance = np.average(along, weights=weights * np.exp(-beside))
    return bool(abs(distance) <= 0.5 * np.abs(normal).sum())
