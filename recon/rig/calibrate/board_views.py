"""Detection of a calibration board in images, with clear errors if it is not found."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from recon.core.errors import CalibrationError, SourceError
from recon.core.values.arrays import UInt8
from recon.core.values.board import CalibrationBoard
from recon.core.words import counted
from recon.io.images.image import read_image
from recon.rig.calibrate.board_size import check_charuco, check_chessboard, grown_size
from recon.rig.calibrate.bundle import Sighting, View
from recon.rig.calibrate.detect import find_board, orient_like
from recon.sources.image_names import ImagePairs
from recon.stereo.rectify.grey import to_grey


@dataclass(frozen=True, eq=False)
class BoardViews:
    """Views of a board in the images of a rig.

    Attributes:
        views: Views in which both cameras see the board, named by the left file.
        pairs: Left and right file of each view, by name.
        empty: Files in which the board is not found.
        size_px: (width, height) of every image.
        count: Number of image pairs.
        board: The board as detected; its ``legacy`` pattern may differ from the one given.
    """

    views: tuple[View, ...]
    pairs: dict[str, tuple[Path, Path]]
    empty: tuple[Path, ...]
    size_px: tuple[int, int]
    count: int
    board: CalibrationBoard


@dataclass(frozen=True, eq=False)
class _Look:
    """The detection in one image; the image itself is not kept."""

    size_px: tuple[int, int]
    seen: Sighting | None
    grown: tuple[int, int] | None


def find_views(images: ImagePairs, board: CalibrationBoard, threads: int) -> BoardViews:
    """Find a board in all images of a rig."""
    files = [path for pair in images.pairs for path in pair]
    board, looks = _look_at_all(files, board, threads)
    size = _one_size(files, looks)
    if board.kind == "chess":
        check_chessboard([look.grown for look in looks], lambda n: _read_grey(files[n]), board)
    elif not any(look.seen for look in looks):
        check_charuco(len(files), lambda n: _read_grey(files[n]), board)
    if not any(look.seen for look in looks):
        raise CalibrationError(
            "the board was not found in any image",
            where=files[0].parent,
            got=counted(len(files), "image"),
            expected=str(board),
            hint="all of it must be in view, with a light margin, sharp and evenly lit",
        )
    empty = tuple(path for path, look in zip(files, looks, strict=True) if look.seen is None)
    views, pairs = {}, {}
    for number, pair in enumerate(images.pairs):
        left, right = (look.seen for look in looks[2 * number : 2 * number + 2])
        if left is not None and right is not None:
            name = pair[0].name
            views[name] = View(name, (left, _same_order(left, right, board)))
            pairs[name] = pair
    return BoardViews(tuple(views.values()), pairs, empty, size, len(images.pairs), board)


def _look_at_all(
    files: Sequence[Path], board: CalibrationBoard, threads: int
) -> tuple[CalibrationBoard, list[_Look]]:
    """Return detections in all images, and the board, which may have OpenCV's legacy pattern."""
    with ThreadPoolExecutor(threads) as pool:
        looks = list(pool.map(lambda path: _look(path, board), files))
        if board.kind == "chess" or any(look.seen for look in looks):
            return board, looks
        other = replace(board, legacy=not board.legacy)
        older = list(pool.map(lambda path: _look(path, other), files))
        return (other, older) if any(look.seen for look in older) else (board, looks)


def _look(path: Path, board: CalibrationBoard) -> _Look:
    grey = _read_grey(path)
    seen = find_board(grey, board)
    grown = None
    if seen is not None and board.kind == "chess":
        grown = grown_size(grey, seen.pixels, board.inner)
    return _Look((grey.shape[1], grey.shape[0]), seen, grown)


def _same_order(left: Sighting, right: Sighting, board: CalibrationBoard) -> Sighting:
    if board.kind == "charuco":  # its corners have ids
        return right
    return replace(right, pixels=orient_like(left.pixels, right.pixels, board.inner))


def _read_grey(path: Path) -> UInt8:
    return to_grey(read_image(path))


def _one_size(files: Sequence[Path], looks: Sequence[_Look]) -> tuple[int, int]:
    first = looks[0].size_px
    for path, look in zip(files, looks, strict=True):
        if look.size_px != first:
            raise SourceError(
                "images differ in size",
                where=path,
                got=f"{look.size_px[0]}x{look.size_px[1]}",
                expected=f"{first[0]}x{first[1]} as {files[0].name}",
                hint="both cameras must record the same size",
            )
    return first
