"""Pictures of a board in, views of it out: reading, finding, and saying what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from recon.calibration import (
    Sighting,
    View,
    check_charuco,
    check_chessboard,
    find_board,
    orient_like,
)
from recon.errors import CalibrationError, SourceError
from recon.formats.image import read_image
from recon.rectification import to_grey
from recon.sources.picture_pairs import PicturePairs
from recon.structures.arrays import UInt8
from recon.structures.board import CalibrationBoard


@dataclass(frozen=True, eq=False)
class BoardViews:
    """What the pictures show of a board.

    Attributes:
        views: Those in which both cameras see it, named by the left file.
        pairs: Left and right file of each of these views, by its name.
        empty: Files in which it is not seen.
        size_px: (width, height) of every picture.
        count: Number of pairs of pictures.
    """

    views: tuple[View, ...]
    pairs: dict[str, tuple[Path, Path]]
    empty: tuple[Path, ...]
    size_px: tuple[int, int]
    count: int


def find_views(pictures: PicturePairs, board: CalibrationBoard, threads: int) -> BoardViews:
    """Find a board in all pictures of a rig.

    Raises:
        FormatError: A picture is missing or damaged.
        SourceError: Pictures differ in size.
        CalibrationError: The board is seen in no pair, or is another one; its size is told.
    """
    files = [path for pair in pictures.pairs for path in pair]
    with ThreadPoolExecutor(threads) as pool:
        greys = list(pool.map(_read_grey, files))
        size = _one_size(files, greys)
        seen = list(pool.map(lambda grey: find_board(grey, board), greys))
    if board.kind == "chess":
        check_chessboard(greys, seen, board)
    elif not any(seen):
        check_charuco(greys, board)
    if not any(seen):
        raise CalibrationError(
            "the board is seen in no picture",
            where=files[0].parent,
            got=f"{len(files)} pictures",
            expected=str(board),
            hint="all of it must be in view, with a light margin, sharp and evenly lit",
        )
    empty = tuple(path for path, sighting in zip(files, seen, strict=True) if sighting is None)
    views, pairs = {}, {}
    for number, pair in enumerate(pictures.pairs):
        left, right = seen[2 * number : 2 * number + 2]
        if left is not None and right is not None:
            name = pair[0].name
            views[name] = View(name, (left, _same_order(left, right, board)))
            pairs[name] = pair
    return BoardViews(tuple(views.values()), pairs, empty, size, len(pictures.pairs))


def _same_order(left: Sighting, right: Sighting, board: CalibrationBoard) -> Sighting:
    if board.kind == "charuco":  # its corners have numbers
        return right
    return replace(right, pixels=orient_like(left.pixels, right.pixels, board.inner))


def _read_grey(path: Path) -> UInt8:
    return to_grey(read_image(path))


def _one_size(files: Sequence[Path], pictures: Sequence[UInt8]) -> tuple[int, int]:
    first = pictures[0].shape
    for path, picture in zip(files, pictures, strict=True):
        if picture.shape != first:
            raise SourceError(
                "pictures differ in size",
                where=path,
                got=f"{picture.shape[1]}x{picture.shape[0]}",
                expected=f"{first[1]}x{first[0]} as {files[0].name}",
                hint="both cameras must record the same size",
            )
    return first[1], first[0]
