"""Find a board in a picture, to a small part of a pixel."""

from __future__ import annotations

from itertools import product
from typing import Final

import cv2
import numpy as np

from recon.adapters.opencv_boards import find_charuco
from recon.calibration.bundle import Sighting
from recon.structures.arrays import Float64, Int32, UInt8
from recon.structures.board import CalibrationBoard

# Finding corners needs no more pixels than this; they are refined in the whole picture.
_SEARCH_WIDTH_PX: Final = 1280
# Half the window of the sub-pixel search, in distances to the nearest corner: as wide as it can be
# without another corner in it.
_WINDOW: Final = 0.33
_SMALLEST_WINDOW_PX: Final = 2
_LARGEST_WINDOW_PX: Final = 25
_SUB_PIXEL: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-5)
_CHESS_FLAGS: Final = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_FEWEST_CORNERS: Final = 8
# A refined corner that moved farther than this, in distances to the next, has been lost.
_LOST: Final = 0.5


def find_board(grey: UInt8, board: CalibrationBoard) -> Sighting | None:
    """Find the corners of a board.

    Args:
        grey: uint8 (H, W).
        board: A chessboard must be seen whole, a ChArUco board may be seen in part.

    Returns:
        None where it is not seen, or too little of it (fewer than 8 corners, or all in one line).

    Raises:
        SettingsError: The dictionary of a ChArUco board is unknown or too small.
    """
    if board.kind == "charuco":
        numbers, pixels = find_charuco(grey, board)
    else:
        found = find_chessboard(grey, board.inner)
        pixels = np.zeros((0, 2)) if found is None else found
        numbers = np.arange(len(pixels), dtype=np.int32)
    if not _enough(numbers, board):
        return None
    # A marker's own edges must stay out of the window.
    free = (board.square_m - board.marker_m) / (2 * board.square_m)
    window = min(_WINDOW, 0.8 * free)
    pixels = refine_corners(grey, pixels, _spacing(numbers, pixels, board), window)
    return Sighting(numbers, board.corners_m[numbers], pixels)


def find_chessboard(grey: UInt8, inner: tuple[int, int]) -> Float64 | None:
    """float64 (N, 2), rough inner corners row by row, or None."""
    scale = min(1.0, _SEARCH_WIDTH_PX / grey.shape[1])
    small = (
        grey
        if scale == 1
        else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    )
    found, corners = cv2.findChessboardCorners(small, inner, flags=_CHESS_FLAGS)
    if not found:
        # Slower and choosier about margins, but sees boards that are tilted or badly lit.
        found, corners = cv2.findChessboardCornersSB(
            small, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        )
    if not found:
        return None
    return np.asarray((np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5)


def refine_corners(
    grey: UInt8, pixels: Float64, spacing_px: float, window: float = _WINDOW
) -> Float64:
    """float64 (N, 2), corners at the crossing of the edges around them.

    Args:
        grey: uint8 (H, W).
        pixels: float64 (N, 2), where they are but for a few pixels.
        spacing_px: Distance between neighbours.
        window: Half of the window looked at, in such distances.
    """
    half = int(np.clip(round(window * spacing_px), _SMALLEST_WINDOW_PX, _LARGEST_WINDOW_PX))
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, start.copy(), (half, half), (-1, -1), _SUB_PIXEL)
    lost = np.linalg.norm(refined - start, axis=2) > _LOST * spacing_px
    return np.where(lost[..., None], start, refined).reshape(-1, 2).astype(np.float64)


def orient_like(reference: Float64, pixels: Float64, inner: tuple[int, int]) -> Float64:
    """Renumber the corners of a whole chessboard so that they run as in another view of it.

    A chessboard looks the same when it is turned by half a turn, and OpenCV begins where it likes.
    Of all orders that keep the neighbours, the one is taken in which the corners lie most like
    those of the reference, up to a shift and a scale.

    Args:
        reference: float64 (N, 2), the left picture's corners.
        pixels: float64 (N, 2), those of the right picture.
        inner: Inner corners along x and y.
    """
    columns, rows = inner
    grid = np.arange(columns * rows).reshape(rows, columns)
    orders = [grid[::a, ::b].ravel() for a, b in product((1, -1), repeat=2)]
    if columns == rows:
        orders += [grid.T[::a, ::b].ravel() for a, b in product((1, -1), repeat=2)]
    likeness = [float((_shape(reference) * _shape(pixels[order])).sum()) for order in orders]
    return pixels[orders[int(np.argmax(likeness))]]


def _shape(pixels: Float64) -> Float64:
    centred = pixels - pixels.mean(axis=0)
    return np.asarray(centred / np.linalg.norm(centred))


def _enough(numbers: Int32, board: CalibrationBoard) -> bool:
    if len(numbers) < min(_FEWEST_CORNERS, len(board.corners_m)):
        return False
    flat = board.corners_m[numbers, :2]
    return bool(np.linalg.matrix_rank(flat - flat.mean(axis=0), tol=1e-9 * board.square_m) == 2)


def _spacing(numbers: Int32, pixels: Float64, board: CalibrationBoard) -> float:
    """Smallest distance between corners that are neighbours on the board, pixels."""
    place = np.full(len(board.corners_m) + board.inner[0], -1)
    place[numbers] = np.arange(len(numbers))
    columns = board.inner[0]
    across = [(n, n + 1) for n in numbers if (n + 1) % columns]
    down = [(n, n + columns) for n in numbers]
    pairs = [(place[a], place[b]) for a, b in [*across, *down] if place[a] >= 0 and place[b] >= 0]
    if not pairs:
        return 3.0 * _SMALLEST_WINDOW_PX
    first, second = np.array(pairs).T
    return float(np.linalg.norm(pixels[first] - pixels[second], axis=1).min())
