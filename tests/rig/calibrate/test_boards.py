"""Boards are found in images, told from others, and printed in their size."""

import re
import zlib
from functools import cache
from itertools import chain

import cv2
import numpy as np
import pytest
from PIL import Image

from recon.core.errors import CalibrationError, OutputError, SettingsError
from recon.core.values.arrays import UInt8
from recon.core.values.board import parse_board
from recon.rig.board_sheet import choose_sheet, write_board
from recon.rig.calibrate.detect import (
    check_charuco,
    check_chessboard,
    grown_size,
    orient_like,
)
from recon.rig.calibrate.patterns import find_board
from tests.scenery.boards import BoardView, board_rig, place_boards, render_views

CHESS = "chess:9x6:25mm"
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
def test_corners_are_found_to_a_tenth_of_a_pixel(text, lens):
    board, errors = parse_board(text), []
    for view, left, _ in rendered(text, lens):
        seen = find_board(left, board)
        truth = view.left_px[seen.numbers]
        found = (
            seen.pixels if board.kind == "charuco" else orient_like(truth, seen.pixels, board.inner)
        )
        errors.append(np.linalg.norm(found - truth, axis=1))
    # Rendering in 4 by 4 samples a pixel, 2 grey levels of noise.
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.12


def test_corners_are_found_in_a_small_copy_of_a_large_image_and_on_half_of_a_charuco_board():
    board, (view, left, _) = parse_board(CHESS), rendered(CHESS)[0]
    seen = find_board(np.kron(left, np.ones((4, 4), np.uint8)), board)
    truth = (view.left_px + 0.5) * 4 - 0.5
    found = orient_like(truth, seen.pixels, board.inner)
    # Four times the pixels: an error of 0.12 of the small ones.
    assert np.sqrt(np.mean(np.sum((found - truth) ** 2, axis=1))) < 0.5
    board = parse_board(CHARUCO)
    view, left, _ = rendered(CHARUCO)[0]
    covered = left.copy()
    covered[:, : int(np.median(view.left_px[:, 0]))] = 90
    seen = find_board(covered, board)
    assert 8 <= len(seen.numbers) < 30
    np.testing.assert_allclose(seen.pixels, view.left_px[seen.numbers], atol=0.5)


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_corners_of_the_right_image_run_as_in_the_left_one(turn):
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
def test_a_wrong_size_is_found_out_and_the_true_one_said(claimed, true):
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


def test_squares_that_were_counted_and_larger_boards_of_which_parts_passed_are_reported():
    shown = images(CHESS)
    with pytest.raises(CalibrationError, match="count inner corners, not squares"):
        check_chessboard([None] * 4, shown.__getitem__, parse_board("chess:10x7:25mm"))
    sizes = [(7, 5), None, None, (7, 5), None, None, None]
    with pytest.raises(CalibrationError, match=r"does not have 7x5.*got 9x6 in \d of 5"):
        check_chessboard(sizes, lambda n: shown[n % 4], parse_board("chess:7x5:25mm"))


def test_a_part_of_a_grid_grows_to_the_whole_but_what_is_cut_off_is_no_other_board():
    view, left, _ = rendered(CHESS)[0]
    grid = view.left_px.reshape(6, 9, 2)
    assert grown_size(left, grid[1:5, 2:8].reshape(-1, 2), (6, 4)) == (9, 6)
    assert grown_size(left, view.left_px, (9, 6)) == (9, 6)
    cut = left.copy()
    cut[:, : int(grid[:, 1].max())] = 90
    check_chessboard([(9, 6)] * 2 + [None] * 4, lambda n: cut, parse_board(CHESS))


@pytest.mark.parametrize(
    ("board", "message"),
    [
        (CHARUCO.replace("5x5_100", "4x4_50"), r"another dictionary \(got \S+, expected 4x4_50"),
        (CHARUCO.replace("8x6", "5x4"), r"marker ids up to 2\d, expected 0 to 9 for 5x4"),
    ],
)
def test_another_charuco_board_is_reported(board, message):
    with pytest.raises(CalibrationError, match=message):
        check_charuco(1, images(CHARUCO).__getitem__, parse_board(board))


def test_a_chessboard_for_a_charuco_board_is_reported_and_the_other_way_round():
    with pytest.raises(CalibrationError, match=r"without markers \(got 9x6 .*chess:9x6"):
        check_charuco(1, images(CHESS).__getitem__, parse_board(CHARUCO))
    shown = images(CHARUCO)
    with pytest.raises(CalibrationError, match=r"board with markers \(ChArUco\) .*5x5_"):
        check_chessboard([None], shown.__getitem__, parse_board("chess:11x9:25mm"))


def test_no_board_is_seen_in_noise_and_unknown_dictionaries_are_refused():
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    assert find_board(noise, parse_board(CHESS)) is None
    assert find_board(noise, parse_board(CHARUCO)) is None
    flat = np.full((240, 320), 90, np.uint8)
    check_chessboard([None], lambda _: flat, parse_board(CHESS))
    check_charuco(1, lambda _: flat, parse_board(CHARUCO))
    blank = np.full((100, 100), 255, np.uint8)
    with pytest.raises(SettingsError, match=r"unknown marker dictionary.*4X4_50"):
        find_board(blank, parse_board("charuco:8x6:30mm:22mm:9x9_10"))
    with pytest.raises(SettingsError, match=r"too few markers.*4x4_50 with 50.*at least 96"):
        find_board(blank, parse_board("charuco:16x12:30mm:22mm:4x4_50"))


PT_PER_MM = 72 / 25.4


@pytest.mark.parametrize(("text", "square_mm"), [(CHESS, 25.0), (CHARUCO, 30.0)])
def test_a_png_has_its_corners_where_they_are_on_paper(tmp_path, text, square_mm):
    board = parse_board(text)
    figures = write_board(tmp_path / "b.png", board, dpi=150).to_json()
    with Image.open(tmp_path / "b.png") as image:
        dpi = image.info["dpi"]
        size_mm = np.array(image.size) * 25.4 / dpi
    assert dpi[0] == pytest.approx(figures["dpi"], rel=1e-4)
    # A page is a whole number of pixels.
    np.testing.assert_allclose(size_mm, (297, 210), atol=0.2)
    grey = cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_GRAYSCALE)
    seen = find_board(grey, board)
    assert len(seen.numbers) == len(board.corners_m)
    columns, rows = board.inner
    grid = seen.pixels.reshape(rows, columns, 2)
    for axis in (0, 1):
        steps = np.linalg.norm(np.diff(grid, axis=axis), axis=2) * 25.4 / dpi[0]
        np.testing.assert_allclose(steps, square_mm, atol=0.02)
    assert grey[0, 0] == 255


@pytest.mark.parametrize(
    ("text", "paper", "page_mm"),
    [(CHESS, "a4", (297, 210)), ("chess:6x9:25mm", "letter", (215.9, 279.4))],
)
def test_a_pdf_has_the_size_of_its_paper_and_squares_of_theirs(tmp_path, text, paper, page_mm):
    board = parse_board(text)
    for name in ("a.pdf", "b.pdf"):
        write_board(tmp_path / name, board, paper)
    content = (tmp_path / "b.pdf").read_bytes()
    assert content == (tmp_path / "a.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[\s*0 0 ([\d.]+) ([\d.]+)", content)
    np.testing.assert_allclose([float(box[1]), float(box[2])], np.array(page_mm) * PT_PER_MM, 1e-5)
    packed = re.findall(rb"stream\r?\n(x.*?)\r?\nendstream", content, re.DOTALL)
    drawn = "\n".join(zlib.decompress(part).decode("latin-1") for part in packed)
    starts = np.array(re.findall(r"([\d.]+) ([\d.]+) m\b", drawn), dtype=float)
    columns, rows = board.squares
    dark = starts[1 : 1 + (columns * rows + 1) // 2]  # the first is the page itself
    x, y = (np.unique(np.round(each, 3)) for each in dark.T)
    assert (len(x), len(y)) == (columns, rows)
    np.testing.assert_allclose(np.diff(x), 25 * PT_PER_MM, atol=2e-3)
    np.testing.assert_allclose(np.diff(y), 25 * PT_PER_MM, atol=2e-3)
    # In the middle: as much paper before the first square as after the last.
    assert x[0] == pytest.approx(float(box[1]) - x[-1] - 25 * PT_PER_MM, abs=2e-3)


@pytest.mark.parametrize(
    ("text", "paper", "name", "across"),
    [
        (CHESS, None, "a4", True),
        ("chess:6x9:25mm", None, "a4", False),
        ("chess:9x6:30mm", None, "a3", True),
        ("chess:11x8:100mm", None, None, True),
        ("chess:9x6:60mm", "700x500mm", "700x500mm", True),
    ],
)
def test_paper_is_the_smallest_that_will_do_and_turned_as_needed(text, paper, name, across):
    board = parse_board(text)
    if name is None:
        with pytest.raises(SettingsError, match=r"does not fit on a0 .*at most \d") as caught:
            choose_sheet(board, paper)
        # Squares as large as the error allows do fit.
        largest = re.search(r"at most ([\d.]+) mm", str(caught.value))
        assert choose_sheet(parse_board(f"chess:11x8:{largest[1]}mm"), paper).name == "a0"
        return
    sheet = choose_sheet(board, paper)
    assert sheet.name == name
    assert (sheet.width_mm > sheet.height_mm) is across


@pytest.mark.parametrize(
    ("text", "name", "options", "error", "message"),
    [
        ("chess:9x6", "b.pdf", {}, SettingsError, "needs the size of its squares"),
        (CHESS, "b.jpg", {}, OutputError, r"b\.jpg: .*PDF or PNG \(got \.jpg"),
        (CHESS, "b", {}, OutputError, "got no suffix"),
        (CHESS, "b.pdf", {"paper": "a9"}, SettingsError, "unknown paper .*a4.*600x400mm"),
        (CHESS, "b.pdf", {"paper": "10x10mm"}, SettingsError, "too small for any board"),
        (
            "chess:9x6:90mm", "b.png", {"dpi": 2400}, SettingsError, "too large .*a smaller --dpi"
        ),
        ("charuco:30x20:5mm:4mm:4x4_50", "b.pdf", {}, SettingsError, "too few markers")
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_one_clear_line_and_no_file(
    tmp_path, text, name, options, error, message
):
    with pytest.raises(error, match=message):
        write_board(tmp_path / name, parse_board(text), **options)
    assert not list(tmp_path.iterdir())
