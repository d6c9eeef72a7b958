"""Views of synthetic boards with exact ground truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.core.values import StereoCalibration
from recon.core.values.board import CalibrationBoard, parse_board
from recon.rig.calibrate.bundle import Sighting, View
from tests.scenery.boards import BoardView, board_rig, place_boards

MakeViews = Callable[..., tuple[StereoCalibration, list[View]]]


def to_view(name: str, board: CalibrationBoard, seen: BoardView) -> View:
    numbers = np.arange(len(board.corners_m), dtype=np.int32)
    sides = (Sighting(numbers, board.corners_m, px) for px in (seen.left_px, seen.right_px))
    return View(name, tuple(sides))


@pytest.fixture(scope="session")
def make_views() -> MakeViews:
    """(lens, count, sigma_px, seed, board) -> true rig and its views."""

    def make(
        lens: str = "radtan",
        count: int = 15,
        sigma_px: float = 0.1,
        seed: int = 0,
        board: str = "chess:9x6:25mm",
    ) -> tuple[StereoCalibration, list[View]]:
        rig, pattern = board_rig(lens), parse_board(board)  # type: ignore[arg-type]
        rng = np.random.default_rng(1000 + seed)
        placed = place_boards(rig, pattern, count, seed)
        return rig, [
            to_view(f"v{n:02d}", pattern, view.noisy(sigma_px, rng))
            for n, view in enumerate(placed)
        ]

    return make
