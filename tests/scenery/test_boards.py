import numpy as np
import pytest

from recon.core.geometry.se3 import apply
from recon.core.values.board import parse_board
from recon.stereo.rectify.lens import project_raw
from tests.scenery.boards import BoardRenderer, board_rig, place_boards

BOARD = parse_board("chess:6x4:30mm")


@pytest.mark.parametrize("lens", ["radtan", "rational", "fisheye"])
def test_squares_between_true_corners_are_dark_and_light_by_turns(lens):
    rig = board_rig(lens)
    for view in place_boards(rig, BOARD, 2):
        for px in (view.left_px, view.right_px):
            assert ((px > 0) & (px < (640, 480))).all()
        T_right_board = rig.T_right_left @ view.T_left_board
        for camera, T in ((rig.left, view.T_left_board), (rig.right, T_right_board)):
            centres = BOARD.corners_m.reshape(4, 6, 3)[:3, :5] + [0.015, 0.015, 0]
            u, v = np.rint(project_raw(camera, apply(T, centres.reshape(-1, 3)))).astype(int).T
            grey = BoardRenderer(camera, BOARD).render(T)[v, u].reshape(3, 5)
            dark = (np.add.outer(np.arange(3), np.arange(5)) % 2) == 0
            assert (grey[dark] < 60).all()
            assert (grey[~dark] > 190).all()


def test_positions_fill_the_image_and_tilt_both_ways():
    views = place_boards(board_rig(), BOARD, 30)
    pixels = np.concatenate([view.left_px for view in views])
    assert np.ptp(pixels, axis=0).min() > 0.7 * 480
    normals = np.array([view.T_left_board[:3, 2] for view in views])
    assert normals[:, :2].min() < -0.2 < 0.2 < normals[:, :2].max()
