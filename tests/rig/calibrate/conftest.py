"""Views of synthetic boards with exact ground truth."""

import numpy as np
import pytest

from recon.core.values.board import parse_board
from recon.rig.calibrate.bundle import Sighting, View
from tests.scenery.boards import board_rig, place_boards


@pytest.fixture(scope="session")
def make_views():
    """(lens, count, sigma_px, seed, board) -> true rig and its views."""

    def make(lens="radtan", count=15, sigma_px=0.1, seed=0, board="chess:9x6:25mm"):
        rig, pattern = board_rig(lens), parse_board(board)
        rng, views = np.random.default_rng(1000 + seed), []
        numbers = np.arange(len(pattern.corners_m), dtype=np.int32)
        for n, placed in enumerate(place_boards(rig, pattern, count, seed)):
            seen = placed.noisy(sigma_px, rng)
            both = (Sighting(numbers, pattern.corners_m, p) for p in (seen.left_px, seen.right_px))
            views.append(View(f"v{n:02d}", tuple(both)))
        return rig, views

    return make
