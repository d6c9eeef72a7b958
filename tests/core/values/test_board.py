from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.values.board import CalibrationBoard, parse_board
from recon.rig.calibrate.detect import dark_rectangles


@pytest.mark.parametrize(
    ("text", "board"),
    [
        ("chess:9x6:25mm", CalibrationBoard("chess", 9, 6, 0.025)),
        ("chess:9x6:2.5cm", CalibrationBoard("chess", 9, 6, 0.025)),
        (" Chess:9X6:0.025 ", CalibrationBoard("chess", 9, 6, 0.025)),
        ("chess:9x6:1in", CalibrationBoard("chess", 9, 6, 0.0254)),
        ("chess:9x6", CalibrationBoard("chess", 9, 6, 1.0, metric=False)),
        ("charuco:8x6:30mm:22mm:4x4_50", CalibrationBoard("charuco", 8, 6, 0.03, 0.022, "4X4_50")),
        ("charuco:8x6:40mm", CalibrationBoard("charuco", 8, 6, 0.04, 0.03, "5X5_100")),
    ],
)
def test_a_board_is_read_from_text(text: str, board: CalibrationBoard) -> None:
    read = parse_board(text)
    assert read.square_m == pytest.approx(board.square_m, rel=1e-12)
    assert read.marker_m == pytest.approx(board.marker_m, rel=1e-12)
    assert (read.kind, read.columns, read.rows) == (board.kind, board.columns, board.rows)
    assert (read.dictionary, read.metric) == (board.dictionary, board.metric)


@pytest.mark.parametrize(
    "text",
    ["chess:9x6:25mm", "charuco:8x6:30mm:22mm:4x4_50", "charuco:8x6:30mm:22mm:4x4_50:legacy"],
)
def test_a_board_tells_itself_as_it_is_read(text: str) -> None:
    assert str(parse_board(text)) == text


@pytest.mark.parametrize(
    "text",
    [
        "9x6",
        "chess",
        "chess:9",
        "chess:9x6:25kg",
        "chess:9x6:25mm:3mm",
        "circles:4x5:3mm",
        "",
        "charuco:8x6:30mm:22mm:4x4_50:older",
    ],
)
def test_what_is_no_board_is_reported_both_forms(text: str) -> None:
    with pytest.raises(SettingsError, match=r"cannot read this board.*chess:9x6:25mm.*charuco:8x6"):
        parse_board(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("chess:9x6:25", "implausible.*got 25 m.*25mm"),
        ("chess:9x1:25mm", "too few inner corners"),
        ("charuco:8x6:30mm:30mm", "markers must be smaller"),
        ("chess:9x6:0mm", "implausible"),
    ],
)
def test_a_board_that_cannot_be_is_refused(text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        parse_board(text)


@pytest.mark.parametrize("text", ["chess:9x6:25mm", "charuco:8x6:30mm:22mm:4x4_50"])
def test_every_inner_corner_is_one_of_two_dark_squares(text: str) -> None:
    board = parse_board(text)
    dark = dark_rectangles(board)
    whole = dark[np.isclose(dark[:, 2] - dark[:, 0], board.square_m)]
    for corner in board.corners_m[:, :2]:
        touching = [
            np.allclose(corner, [x, y])
            for x0, y0, x1, y1 in whole
            for x in (x0, x1)
            for y in (y0, y1)
        ]
        assert sum(touching) == 2
    assert len(board.corners_m) == board.inner[0] * board.inner[1]
