from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from recon.odometry import features
from recon.odometry.features import find_corners, find_fewer_corners, follow, in_crowd
from recon.odometry.protocol import OdometryFrame

NONE = np.zeros((0, 2), np.float32)


def per_cell(uv: np.ndarray) -> np.ndarray:
    cells = (uv[:, 1] // features._CELL_PX) * 1000 + uv[:, 0] // features._CELL_PX
    return np.unique(cells, return_counts=True)[1]


def test_no_cell_holds_more_than_its_share(see: Callable[..., OdometryFrame]) -> None:
    uv = find_corners(see(np.eye(4)).pair.left, NONE)
    assert len(uv) > 50
    assert per_cell(uv).max() <= features._PER_CELL


def test_features_already_followed_fill_their_cells(see: Callable[..., OdometryFrame]) -> None:
    grey = see(np.eye(4)).pair.left
    first = find_corners(grey, NONE)
    more = find_corners(grey, first)
    assert per_cell(np.concatenate([first, more])).max() <= features._PER_CELL
    distance = np.linalg.norm(first[:, None] - more[None], axis=2)
    assert distance.size == 0 or distance.min() >= features._DISTANCE_PX


def test_of_a_crowd_those_that_come_first_stay() -> None:
    gathered = np.array([[50.0, 50.0], [np.nan, np.nan], [200.0, 10.0]] + 4 * [[45.0, 60.0]])
    expected = [False, False, False, False, False, True, True]
    assert in_crowd(gathered, (100, 300)).tolist() == expected
    assert in_crowd(np.zeros((0, 2)), (100, 300)).shape == (0,)


def test_the_corners_of_a_square_are_found() -> None:
    grey = np.full((100, 100), 50, np.uint8)
    grey[30:60, 30:60] = 200
    uv = find_corners(grey, NONE, cell_px=20)
    square = np.array([[29.5, 29.5], [59.5, 29.5], [29.5, 59.5], [59.5, 59.5]])
    distance = np.linalg.norm(uv[:, None] - square[None], axis=2)
    assert len(uv) >= 4
    assert distance.min(axis=0).max() < 3.0
    assert distance.min(axis=1).max() < 3.0


def test_nothing_is_found_where_nothing_is() -> None:
    assert find_corners(np.full((80, 90), 128, np.uint8), NONE).shape == (0, 2)
    assert find_corners(np.zeros((5, 5), np.uint8), NONE).shape == (0, 2)


def test_fewer_corners_are_corners_too(see: Callable[..., OdometryFrame]) -> None:
    grey = see(np.eye(4)).pair.left
    many, few = find_corners(grey, NONE), find_fewer_corners(grey, NONE)

    assert 0.15 < len(few) / len(many) < 0.6
    score = cv2.cornerMinEigenVal(grey, 5)
    column, row = few.astype(int).T
    assert np.median(score[row, column]) > np.median(score)
    more = find_fewer_corners(grey, few)
    assert len(more) < 0.2 * len(few)


def test_what_leaves_the_image_is_not_followed(see: Callable[..., OdometryFrame]) -> None:
    grey = see(np.eye(4)).pair.left
    uv = find_corners(grey, NONE)
    shift = np.array([30, 12])
    moved = np.roll(grey, shift[::-1], axis=(0, 1))
    there, found = follow(grey, moved, uv, (uv + shift).astype(np.float32))
    height, width = grey.shape
    inside = (uv + shift < [width - 15, height - 15]).all(axis=1)
    assert found[inside].mean() > 0.9
    assert np.median(np.abs(there - uv - shift)[found & inside]) < 0.01
    assert not found[((there > [width - 1, height - 1]) | (there < 0)).any(axis=1)].any()
