from __future__ import annotations

from functools import cache
from itertools import chain

import cv2
import numpy as np
import pytest

from recon.core.errors import CalibrationError, SettingsError
from recon.core.values.arrays import UInt8
from recon.core.values.board import parse_board
from recon.rig.calibrate.detect import (
    check_charuco,
    check_chessboard,
    find_board,
    grown_size,
    orient_like,
)
from tests.scenery.boards import BoardView, board_rig, place_boards, render_views

CHARUCO = "charuco:8x6:30mm:22mm:5x5_100"


@cache
def rendered(text: str, lens: str = "radtan") -> list[tuple[BoardView, UInt8, UInt8]]:
    rig, board = board_rig(lens), parse_board(text)  # type: ignore[arg-type]
    views = place_boards(rig, board, 2, seed=5)
    images = render_views(rig, board, views)
    return [(view, *pair) for view, pair in zip(views, images, strict=True)]


def images(text: str) -> list[UInt8]:
    """The images at half size: which board they show is asked, not where its corners are."""
    both = chain.from_iterable((left, right) for _, left, right in rendered(text))
    return [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in both]


@pytest.mark.parametrize("lens", ["radtan", "fisheye"])
@pytest.mark.parametrize("text", ["chess:9x6:25mm", "chess:7x7:25mm", CHARUCO])
def test_corners_are_found_to_a_tenth_of_a_pixel(text: str, lens: str) -> None:
    board, errors = parse_board(text), []
    for view, left, _ in rendered(text, lens):
        seen = find_board(left, board)
        assert seen is not None
        truth = view.left_px[seen.numbers]
        found = (
            seen.pixels if board.kind == "charuco" else orient_like(truth, seen.pixels, board.inner)
        )
        errors.append(np.linalg.norm(found - truth, axis=1))
    # Rendering in 4 by 4 samples a pixel, 2 grey levels of noise.
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.12


def test_corners_of_a_large_image_are_found_in_a_small_copy_and_refined_in_it() -> None:
    board = parse_board("chess:9x6:25mm")
    view, left, _ = rendered("chess:9x6:25mm")[0]
    large = np.kron(left, np.ones((4, 4), np.uint8))
    seen = find_board(large, board)
    assert seen is not None
    truth = (view.left_px + 0.5) * 4 - 0.5
    found = orient_like(truth, seen.pixels, board.inner)
    # Four times the pixels: an error of 0.12 of the small ones.
    assert np.sqrt(np.mean(np.sum((found - truth) ** 2, axis=1))) < 0.5


def test_a_charuco_board_that_is_half_covered_is_used_in_part() -> None:
    board = parse_board(CHARUCO)
    view, left, _ = rendered(CHARUCO)[0]
    covered = left.copy()
    covered[:, : int(np.median(view.left_px[:, 0]))] = 90
    seen = find_board(covered, board)
    assert seen is not None
    assert 8 <= len(seen.numbers) < 30
    np.testing.assert_allclose(seen.pixels, view.left_px[seen.numbers], atol=0.5)


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_corners_of_the_right_image_run_as_in_the_left_one(turn: int) -> None:
    board = parse_board("chess:7x7:25mm")
    view = rendered("chess:7x7:25mm")[0][0]
    grid = np.rot90(view.right_px.reshape(7, 7, 2), turn).reshape(-1, 2)
    np.testing.assert_array_equal(orient_like(view.left_px, grid, board.inner), view.right_px)


@pytest.mark.parametrize(
    ("claimed", "true"),
    [
        ("6x9", "9x6"),
        ("8x6", "9x6"),
        ("10x7", "7x7"),
        # A board that is not found is searched for long.
        *(
            pytest.param(*sizes, marks=pytest.mark.slow)
            for sizes in (("10x7", "9x6"), ("6x9", "7x7"), ("8x6", "7x7"))
        ),
    ],
)
def test_a_wrong_size_is_found_out_and_the_true_one_said(claimed: str, true: str) -> None:
    board, shown = parse_board(f"chess:{claimed}:25mm"), images(f"chess:{true}:25mm")
    seen = [find_board(image, board) for image in shown]
    sizes = [
        None if sighting is None else grown_size(image, sighting.pixels, board.inner)
        for image, sighting in zip(shown, seen, strict=True)
    ]
    if sorted(claimed.split("x")) == sorted(true.split("x")):
        assert None not in sizes
        check_chessboard(sizes, shown.__getitem__, board)
        return
    said = true if board.columns > board.rows else "x".join(sorted(true.split("x")))
    with pytest.raises(CalibrationError, match=rf"does not have {claimed}.*got {said} in"):
        check_chessboard(sizes, shown.__getitem__, board)


def test_squares_that_were_counted_for_corners_are_reported() -> None:
    board, shown = parse_board("chess:10x7:25mm"), images("chess:9x6:25mm")
    with pytest.raises(CalibrationError, match="count inner corners, not squares"):
        check_chessboard([None] * len(shown), shown.__getitem__, board)


def test_a_part_of_a_grid_grows_to_the_whole_and_the_whole_no_further() -> None:
    view, left, _ = rendered("chess:9x6:25mm")[0]
    grid = view.left_px.reshape(6, 9, 2)
    assert grown_size(left, grid[1:5, 2:8].reshape(-1, 2), (6, 4)) == (9, 6)
    assert grown_size(left, view.left_px, (9, 6)) == (9, 6)


def test_markers_of_another_dictionary_are_reported() -> None:
    board = parse_board("charuco:8x6:30mm:22mm:4x4_50")
    with pytest.raises(CalibrationError, match=r"another dictionary \(got \S+, expected 4x4_50"):
        check_charuco(1, images(CHARUCO).__getitem__, board)


def test_a_charuco_board_of_another_size_is_reported() -> None:
    board = parse_board("charuco:5x4:30mm:22mm:5x5_100")
    with pytest.raises(CalibrationError, match=r"marker ids up to 2\d, expected 0 to 9 for 5x4"):
        check_charuco(1, images(CHARUCO).__getitem__, board)


def test_a_larger_board_is_reported_although_parts_of_it_passed_for_the_claimed_one() -> None:
    shown = images("chess:9x6:25mm")
    sizes = [(7, 5), None, None, (7, 5), None, None, None]
    with pytest.raises(CalibrationError, match=r"does not have 7x5.*got 9x6 in \d of 5"):
        check_chessboard(sizes, lambda n: shown[n % 4], parse_board("chess:7x5:25mm"))


def test_views_of_a_part_of_the_claimed_board_are_no_other_board() -> None:
    """Most images cut the board off: what is left of it is no proof."""
    view, left, _ = rendered("chess:9x6:25mm")[0]
    cut = left.copy()
    cut[:, : int(view.left_px.reshape(6, 9, 2)[:, 1].max())] = 90
    sizes = [(9, 6), (9, 6), None, None, None, None]
    check_chessboard(sizes, lambda n: cut, parse_board("chess:9x6:25mm"))


def test_a_chessboard_for_a_charuco_board_is_reported_and_the_other_way_round() -> None:
    with pytest.raises(CalibrationError, match=r"without markers \(got 9x6 .*chess:9x6"):
        check_charuco(1, images("chess:9x6:25mm").__getitem__, parse_board(CHARUCO))
    shown = images(CHARUCO)
    with pytest.raises(CalibrationError, match=r"board with markers \(ChArUco\) .*5x5_"):
        check_chessboard([None], shown.__getitem__, parse_board("chess:11x9:25mm"))


def test_no_board_is_seen_in_noise() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    assert find_board(noise, parse_board("chess:9x6:25mm")) is None
    assert find_board(noise, parse_board(CHARUCO)) is None
    flat = np.full((240, 320), 90, np.uint8)
    check_chessboard([None], lambda _: flat, parse_board("chess:9x6:25mm"))
    check_charuco(1, lambda _: flat, parse_board(CHARUCO))


def test_an_unknown_or_small_dictionary_is_refused() -> None:
    blank = np.full((100, 100), 255, np.uint8)
    with pytest.raises(SettingsError, match=r"unknown marker dictionary.*4X4_50"):
        find_board(blank, parse_board("charuco:8x6:30mm:22mm:9x9_10"))
    with pytest.raises(SettingsError, match=r"too few markers.*4x4_50 with 50.*at least 96"):
        find_board(blank, parse_board("charuco:16x12:30mm:22mm:4x4_50"))
