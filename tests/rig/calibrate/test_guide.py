"""What is said of a board while it is recorded."""

import cv2
import numpy as np
import pytest

from recon.core.values.arrays import UInt8
from recon.core.values.board import parse_board
from recon.rig.calibrate.guide import BoardGuide, fault_of, guided
from recon.rig.calibrate.patterns import find_board
from recon.rig.capture import CapturedPair
from tests.scenery.boards import BoardRenderer, board_rig, place_boards, render_views

BOARD = parse_board("chess:9x6:25mm")


def pair_of(left: UInt8, right: UInt8) -> CapturedPair:
    return CapturedPair(np.dstack([left] * 3), np.dstack([right] * 3), 0.0, 0.0)


def test_the_guide_says_which_views_are_missing_until_there_are_enough():
    rig = board_rig()
    guide, flat = BoardGuide(BOARD), np.full((480, 640), 21, np.uint8)
    assert guide.advice() == "no view of the board yet"
    assert "no board in the left image" in guide.look(pair_of(flat, flat))
    shown = render_views(rig, BOARD, place_boards(rig, BOARD, 6, seed=3))
    said = [guide.look(pair_of(*images)) for images in shown]
    assert said[0].startswith("1 view of 20; show it at the ")
    assert "nearer and farther" in said[0]
    assert said[-1] == guide.advice()
    assert int(said[-1].split()[0]) == len(shown)
    guide.look(pair_of(*shown[0]))  # again: no other view
    assert guide.advice() == said[-1]


@pytest.fixture(scope="module")
def sharp():
    camera = board_rig().left
    view = place_boards(board_rig(), BOARD, 1, seed=5)[0]
    return BoardRenderer(camera, BOARD).render(view.T_left_board).astype(np.float64)


@pytest.mark.parametrize(
    ("gain", "blur_px", "noise_dn", "said"),
    [
        (1.0, 0.6, 2.0, ""),
        (0.3, 0.6, 1.0, ""),  # dark, but the sensor is good
        (0.05, 0.6, 2.0, "too dark"),
        (1.0, 3.5, 2.0, "blurred"),
    ],
)
def test_darkness_is_told_from_blur_by_what_corners_lose(sharp, gain, blur_px, noise_dn, said):
    image = cv2.GaussianBlur(gain * sharp, (0, 0), blur_px)
    image += np.random.default_rng(0).normal(0, noise_dn, image.shape)
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    board = find_board(cv2.GaussianBlur(sharp.astype(np.uint8), (0, 0), 0.6), BOARD)
    assert fault_of(grey, board).startswith(said)
    assert bool(fault_of(grey, board)) == bool(said)


def test_pairs_pass_the_guide_in_their_order():
    flat = np.full((48, 64), 90, np.uint8)
    pairs = [pair_of(flat, flat) for _ in range(5)]
    assert list(guided(iter(pairs), BoardGuide(BOARD))) == pairs
