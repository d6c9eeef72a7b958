"""The twins of `recon.map.kernels.clamped`: dictionaries of cells, for reading and testing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int, int]
Clamped = tuple[float, float, float]
"""Sum, low, high: stands for ``x → min(max(x + sum, low), high)``."""


def apply_evidence_reference(
    log_odds: dict[Cell, float], evidence: dict[Cell, float], lowest: float, highest: float
) -> None:
    """Add a frame's evidence to the log-odds of a map and clamp: what a part stands for."""
    for cell, change in evidence.items():
        log_odds[cell] = min(max(log_odds.get(cell, 0.0) + change, lowest), highest)


def chain_reference(first: dict[Cell, Clamped], then: dict[Cell, Clamped]) -> dict[Cell, Clamped]:
    """What two parts of a drive did to each cell, one after the other."""
    both = {**first, **then}
    for cell in first.keys() & then.keys():
        total, low, high = first[cell]
        change, lowest, highest = then[cell]
        both[cell] = (
            total + change,
            min(max(low + change, lowest), highest),
            min(max(high + change, lowest), highest),
        )
    return both


def move_reference(cells: dict[Cell, Clamped], T_new_old: NDArray[Any]) -> dict[Cell, Clamped]:
    """Each new cell takes what the old cell at its centre has."""
    centres = np.array(list(cells), dtype=np.float64).reshape(-1, 3) + 0.5
    T_old_new = np.linalg.inv(T_new_old)
    moved: dict[Cell, Clamped] = {}
    for centre in centres @ T_new_old[:3, :3].T + T_new_old[:3, 3]:
        home = np.floor(centre).astype(int)
        for offset in np.ndindex(3, 3, 3):
            i, j, k = (home + np.array(offset) - 1).tolist()
            x, y, z = (T_old_new[:3, :3] @ [i + 0.5, j + 0.5, k + 0.5] + T_old_new[:3, 3]).tolist()
            old = (math.floor(x), math.floor(y), math.floor(z))
            if old in cells:
                moved[i, j, k] = cells[old]
    return moved
