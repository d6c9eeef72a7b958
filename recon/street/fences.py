"""What one looks through and what still stands: fences, railings, hedges, wires, shop windows.

Axes of a section: x along the street, y away from the road, z up, its base at z = 0. Sections are
`SECTION_M` long.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry import se3
from recon.street.shapes import boxes, bumpy_ball
from recon.street.soup import Material, Paint, TriangleSoup, merge, move

SECTION_M: Final = 9.0
_POSTERS: Final = [(0.62, 0.30, 0.22), (0.25, 0.42, 0.62), (0.66, 0.58, 0.25), (0.35, 0.52, 0.36)]


def picket_fence(rng: np.random.Generator) -> TriangleSoup:
    """Return upright boards with gaps nearly as wide as they are, on two rails between posts."""
    wood = Paint(Material.BARK, (0.42, 0.34, 0.26), int(rng.integers(1, 2**30)))
    height = float(rng.uniform(0.9, 1.3))
    boards = _row(float(rng.uniform(0.13, 0.17)), (0.08, 0.02, height), wood)
    return merge([boards, _rails((0.3, height - 0.25), 0.05, wood), _posts(3.0, height + 0.1)])


def railing(rng: np.random.Generator) -> TriangleSoup:
    """Return thin iron bars between two rails."""
    iron = Paint(Material.METAL, (0.16, 0.17, 0.17), int(rng.integers(1, 2**30)))
    return merge([_row(0.12, (0.02, 0.02, 1.05), iron), _rails((0.1, 1.0), 0.04, iron)])


def hedge(rng: np.random.Generator) -> TriangleSoup:
    """Return a row of bushes; between some of them one sees through."""
    parts = []
    for x in np.arange(0.5, SECTION_M, float(rng.uniform(0.8, 1.05))):
        leaves = Paint(Material.LEAVES, (0.26, 0.38, 0.16), int(rng.integers(1, 2**30)))
        ball = bumpy_ball((0.55, 0.45, 0.75), leaves, bump=0.35, wavelength=0.2, seed=leaves.part)
        parts.append(move(ball, se3.make_transform(np.eye(3), np.array([x, 0.0, 0.7]))))
    return merge(parts)


def wires(rng: np.random.Generator) -> TriangleSoup:
    """Return five wires between posts."""
    steel = Paint(Material.METAL, (0.55, 0.56, 0.57), int(rng.integers(1, 2**30)))
    return merge([_rails(tuple(np.linspace(0.3, 1.5, 5)), 0.02, steel), _posts(4.5, 1.6)])


def shop_window(rng: np.random.Generator) -> TriangleSoup:
    """Return the frame of a window and boards behind it; clear glass is not seen."""
    frame = Paint(Material.METAL, (0.30, 0.31, 0.32), int(rng.integers(1, 2**30)))
    parts = [_rails((0.4, 2.3), 0.07, frame), _row(1.5, (0.06, 0.06, 2.4), frame)]
    for x in np.arange(0.2, SECTION_M - 1.2, 1.3):
        colour = _POSTERS[rng.integers(len(_POSTERS))]
        board = Paint(Material.POSTER, colour, int(rng.integers(1, 2**30)))
        away = float(rng.uniform(0.5, 1.2))
        parts.append(boxes([x, away, 0.4], [x + 1.1, away + 0.05, rng.uniform(1.2, 2.2)], board))
    return merge(parts)


SECTIONS: Final = (picket_fence, railing, hedge, wires, shop_window)


def _row(step_m: float, size_m: tuple[float, float, float], paint: Paint) -> TriangleSoup:
    """Return upright bars of one size in a row."""
    x = np.arange(0.0, SECTION_M, step_m)
    low = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    return boxes(low, low + size_m, paint)


def _rails(heights_m: tuple[float, ...], thick_m: float, paint: Paint) -> TriangleSoup:
    """Return bars along the section."""
    low = np.array([[0.0, 0.02, height] for height in heights_m])
    return boxes(low, low + np.array([SECTION_M, thick_m, thick_m]), paint)


def _posts(step_m: float, height_m: float) -> TriangleSoup:
    """Return posts that carry a fence."""
    grey = Paint(Material.PLAIN, (0.60, 0.59, 0.56), 1)
    return _row(step_m, (0.12, 0.12, height_m), grey)
