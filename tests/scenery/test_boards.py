from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.se3 import apply
from recon.core.values.board import parse_board
from recon.stereo.rectify.lens import project_raw
from tests.scenery.boards import BoardRenderer, board_rig, place_boards

BOARD = parse_board("chess:6x4:30mm")


@pytest.mark.parametrize("lens", ["radtan", "rational", "fisheye"])
def test_truth_of_a_view_is_the_projection_of_the_board(lens: str) -> None:
    rig = board_rig(lens)  # type: ignore[arg-type]
    for view in place_boards(rig, BOARD, 5):
        xyz = apply(view.T_left_board, BOARD.corners_m)
        np.testing.assert_array_equal(view.left_px, project_raw(rig.left, xyz))
        right = project_raw(rig.right, apply(rig.T_right_left, xyz))
        np.testing.assert_array_equal(view.right_px, right)
        assert (view.left_px > 0).all()
        assert (view.left_px < (640, 480)).all()


def test_squares_between_true_corners_are_dark_and_light_by_turns() -> None:
    rig = board_rig("fisheye")
    (view,) = place_boards(rig, BOARD, 1)
    image = BoardRenderer(rig.left, BOARD).render(view.T_left_board)
    centres = BOARD.corners_m.reshape(4, 6, 3)[:3, :5] + [0.015, 0.015, 0]
    xyz = apply(view.T_left_board, centres.reshape(-1, 3))
    u, v = np.rint(project_raw(rig.left, xyz)).astype(int).T
    grey = image[v, u].reshape(3, 5)
    dark = (np.add.outer(np.arange(3), np.arange(5)) % 2) == 0
    assert (grey[dark] < 60).all()
    assert (grey[~dark] > 190).all()


def test_positions_fill_the_image_and_tilt_both_ways() -> None:
    rig = board_rig()
    views = place_boards(rig, BOARD, 30)
    pixels = np.concatenate([view.left_px for view in views])
    assert np.ptp(pixels, axis=0).min() > 0.7 * 480
    normals = np.array([view.T_left_board[:3, 2] for view in views])
    assert normals[:, :2].min() < -0.2 < 0.2 < normals[:, :2].max()
