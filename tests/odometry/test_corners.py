from __future__ import annotations

from collections.abc import Callable

import numpy as np

from recon.odometry.corners import find_corners
from recon.odometry.protocol import OdometryFrame
from recon.odometry.settings import CornerSettings

NONE = np.zeros((0, 2), np.float32)
SETTINGS = CornerSettings()


def per_cell(uv: np.ndarray) -> np.ndarray:
    cells = (uv[:, 1] // SETTINGS.cell_px) * 1000 + uv[:, 0] // SETTINGS.cell_px
    return np.unique(cells, return_counts=True)[1]


def test_no_cell_holds_more_than_its_share(see: Callable[..., OdometryFrame]) -> None:
    uv = find_corners(see(np.eye(4)).pair.left, NONE, SETTINGS)
    assert len(uv) > 50
    assert per_cell(uv).max() <= SETTINGS.per_cell


def test_features_already_followed_fill_their_cells(see: Callable[..., OdometryFrame]) -> None:
    grey = see(np.eye(4)).pair.left
    first = find_corners(grey, NONE, SETTINGS)
    more = find_corners(grey, first, SETTINGS)
    assert per_cell(np.concatenate([first, more])).max() <= SETTINGS.per_cell
    distance = np.linalg.norm(first[:, None] - more[None], axis=2)
    assert distance.size == 0 or distance.min() >= SETTINGS.distance_px


def test_the_corners_of_a_square_are_found() -> None:
    grey = np.full((100, 100), 50, np.uint8)
    grey[30:60, 30:60] = 200
    uv = find_corners(grey, NONE, CornerSettings(cell_px=20))
    square = np.array([[29.5, 29.5], [59.5, 29.5], [29.5, 59.5], [59.5, 59.5]])
    distance = np.linalg.norm(uv[:, None] - square[None], axis=2)
    assert len(uv) >= 4
    assert distance.min(axis=0).max() < 3.0
    assert distance.min(axis=1).max() < 3.0


def test_nothing_is_found_where_nothing_is() -> None:
    assert find_corners(np.full((80, 90), 128, np.uint8), NONE, SETTINGS).shape == (0, 2)
    assert find_corners(np.zeros((5, 5), np.uint8), NONE, SETTINGS).shape == (0, 2)
