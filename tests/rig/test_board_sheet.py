from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from recon.core.errors import OutputError, SettingsError
from recon.core.values.board import parse_board
from recon.rig.board_sheet import choose_sheet, write_board
from recon.rig.calibrate.detect import find_board

CHESS = "chess:9x6:25mm"
CHARUCO = "charuco:8x6:30mm:22mm:5x5_100"
PT_PER_MM = 72 / 25.4


@pytest.mark.parametrize(("text", "square_mm"), [(CHESS, 25.0), (CHARUCO, 30.0)])
def test_a_png_has_its_corners_where_they_are_on_paper(
    tmp_path: Path, text: str, square_mm: float
) -> None:
    board = parse_board(text)
    figures = write_board(tmp_path / "b.png", board, dpi=150)
    with Image.open(tmp_path / "b.png") as image:
        dpi = image.info["dpi"]
        size_mm = np.array(image.size) * 25.4 / dpi
    assert dpi[0] == pytest.approx(figures["dpi"], rel=1e-4)
    # A page is a whole number of pixels.
    np.testing.assert_allclose(size_mm, (297, 210), atol=0.2)
    grey = cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_GRAYSCALE)
    seen = find_board(grey, board)
    assert seen is not None
    assert len(seen.numbers) == len(board.corners_m)
    columns, rows = board.inner
    grid = seen.pixels.reshape(rows, columns, 2)
    for axis in (0, 1):
        steps = np.linalg.norm(np.diff(grid, axis=axis), axis=2) * 25.4 / dpi[0]
        np.testing.assert_allclose(steps, square_mm, atol=0.02)
    assert grey[0, 0] == 255


def pdf_streams(path: Path) -> str:
    """Everything that a PDF draws, unpacked."""
    packed = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", path.read_bytes(), re.DOTALL)
    return "\n".join(zlib.decompress(part).decode("latin-1") for part in packed if part[:1] == b"x")


@pytest.mark.parametrize(
    ("text", "paper", "page_mm"),
    [(CHESS, "a4", (297, 210)), ("chess:6x9:25mm", "letter", (215.9, 279.4))],
)
def test_a_pdf_has_the_size_of_its_paper_and_squares_of_theirs(
    tmp_path: Path, text: str, paper: str, page_mm: tuple[float, float]
) -> None:
    board = parse_board(text)
    write_board(tmp_path / "b.pdf", board, paper)
    content = (tmp_path / "b.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[\s*0 0 ([\d.]+) ([\d.]+)", content)
    assert box is not None
    np.testing.assert_allclose([float(box[1]), float(box[2])], np.array(page_mm) * PT_PER_MM, 1e-5)
    drawn = pdf_streams(tmp_path / "b.pdf")
    starts = np.array(re.findall(r"([\d.]+) ([\d.]+) m\b", drawn), dtype=float)
    columns, rows = board.squares
    dark = starts[1 : 1 + (columns * rows + 1) // 2]  # the first is the page itself
    x, y = (np.unique(np.round(each, 3)) for each in dark.T)
    assert (len(x), len(y)) == (columns, rows)
    np.testing.assert_allclose(np.diff(x), 25 * PT_PER_MM, atol=2e-3)
    np.testing.assert_allclose(np.diff(y), 25 * PT_PER_MM, atol=2e-3)
    # In the middle: as much paper before the first square as after the last.
    assert x[0] == pytest.approx(float(box[1]) - x[-1] - 25 * PT_PER_MM, abs=2e-3)


def test_the_same_board_is_the_same_file(tmp_path: Path) -> None:
    for name in ("a.pdf", "b.pdf"):
        write_board(tmp_path / name, parse_board(CHESS))
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


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
def test_paper_is_the_smallest_that_will_do_and_turned_as_needed(
    text: str, paper: str | None, name: str | None, across: bool
) -> None:
    board = parse_board(text)
    if name is None:
        with pytest.raises(SettingsError, match=r"does not fit on a0 .*squares of at most \d"):
            choose_sheet(board, paper)
        return
    sheet = choose_sheet(board, paper)
    assert sheet.name == name
    assert (sheet.width_mm > sheet.height_mm) is across


def test_squares_as_large_as_the_error_allows_do_fit() -> None:
    with pytest.raises(SettingsError, match="does not fit on a4") as caught:
        choose_sheet(parse_board("chess:9x6:40mm"), "a4")
    largest = re.search(r"at most ([\d.]+) mm", str(caught.value))
    assert largest is not None
    assert choose_sheet(parse_board(f"chess:9x6:{largest[1]}mm"), "a4").name == "a4"


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
    tmp_path: Path, text: str, name: str, options, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        write_board(tmp_path / name, parse_board(text), **options)
    assert not list(tmp_path.iterdir())
