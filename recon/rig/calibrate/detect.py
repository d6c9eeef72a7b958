"""Detection of board corners in an image, with subpixel accuracy."""

from __future__ import annotations

from itertools import product
from typing import Final

import cv2
import numpy as np

from recon.core.values.arrays import Float64, Int32, UInt8
from recon.core.values.board import CalibrationBoard
from recon.rig.calibrate.bundle import Sighting
from recon.rig.opencv_boards import find_charuco

# Corners are detected at this width at most, and refined at full resolution.
_SEARCH_WIDTH_PX: Final = 1280
# Half the window of the subpixel search, relative to the corner spacing: as wide as possible
# without another corner in it.
_WINDOW: Final = 0.33
_SMALLEST_WINDOW_PX: Final = 2
_LARGEST_WINDOW_PX: Final = 25
_SUB_PIXEL: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-5)
_CHESS_FLAGS: Final = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_FEWEST_CORNERS: Final = 8
# A corner that refinement moves farther than this, relative to the spacing, keeps its old position.
_LOST: Final = 0.5


def find_board(grey: UInt8, board: CalibrationBoard) -> Sighting | None:
    """Find the corners of a board.

    Args:
        grey: uint8 (H, W).
        board: A chessboard must be fully visible, a ChArUco board may be partly visible.

    Returns:
        None if the board is not found, or too little of it (fewer than 8 corners, or collinear).
    """
    if board.kind == "charuco":
        numbers, pixels = find_charuco(grey, board)
    else:
        found = find_chessboard(grey, board.inner)
        pixels = np.zeros((0, 2)) if found is None else found
        numbers = np.arange(len(pixels), dtype=np.int32)
    if not _enough(numbers, board):
        return None
    # The edges of the markers must stay outside the window.
    free = (board.square_m - board.marker_m) / (2 * board.square_m)
    window = min(_WINDOW, 0.8 * free)
    pixels = refine_corners(grey, pixels, _spacing(numbers, pixels, board), window)
    return Sighting(numbers, board.corners_m[numbers], pixels)


def find_chessboard(grey: UInt8, inner: tuple[int, int]) -> Float64 | None:
    """Return float64 (N, 2), approximate inner corners row by row, or None."""
    scale = min(1.0, _SEARCH_WIDTH_PX / grey.shape[1])
    small = (
        grey
        if scale == 1
        else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    )
    found, corners = cv2.findChessboardCorners(small, inner, flags=_CHESS_FLAGS)
    if not found:
        # Slower and stricter about margins, but finds tilted and badly lit boards.
        found, corners = cv2.findChessboardCornersSB(
            small, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        )
    if not found:
        return None
    return np.asarray((np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5)


def refine_corners(
    grey: UInt8, pixels: Float64, spacing_px: float, window: float = _WINDOW
) -> Float64:
    """Return float64 (N, 2), corners refined to subpixel accuracy.

    Args:
        grey: uint8 (H, W).
        pixels: float64 (N, 2), corners to within a few pixels.
        spacing_px: Distance between neighbouring corners.
        window: Half width of the search window, relative to the spacing.
    """
    half = int(np.clip(round(window * spacing_px), _SMALLEST_WINDOW_PX, _LARGEST_WINDOW_PX))
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, start.copy(), (half, half), (-1, -1), _SUB_PIXEL)
    lost = np.linalg.norm(refined - start, axis=2) > _LOST * spacing_px
    return np.where(lost[..., None], start, refined).reshape(-1, 2).astype(np.float64)


def orient_like(reference: Float64, pixels: Float64, inner: tuple[int, int]) -> Float64:
    """Reorder the corners of a whole chessboard as in another view of it.

    A chessboard looks the same when rotated by 180 degrees, and OpenCV may start at either end. Of
    all orders that preserve neighbours, this takes the one that resembles the reference most, up
    to translation and scale.

    Args:
        reference: float64 (N, 2), corners in the left image.
        pixels: float64 (N, 2), corners in the right image.
        inner: Number of inner corners along x and y.
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
    """Return the smallest distance between neighbouring corners of the board, pixels."""
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
