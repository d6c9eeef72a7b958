"""OpenCV's ChArUco boards: marker dictionaries, board layout and detector."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np

from recon.core.errors import SettingsError
from recon.core.values.arrays import Float64, Int32, UInt8
from recon.core.values.board import CalibrationBoard

_PREFIX: Final = "DICT_"


def dictionary_names() -> list[str]:
    """Return names of OpenCV's marker dictionaries, in upper case, without ``DICT_``."""
    return sorted({n[len(_PREFIX) :].upper() for n in dir(cv2.aruco) if n.startswith(_PREFIX)})


def dark_rectangles(board: CalibrationBoard) -> Float64:
    """Return float64 (M, 4), the dark rectangles of a board: x0, y0, x1, y1 in metres.

    The origin is the first inner corner, as in `CalibrationBoard.corners_m`.
    """
    if board.kind == "chess":
        columns, rows = board.squares
        dark = [(x, y) for y in range(rows) for x in range(columns) if (x + y) % 2 == 0]
        low = np.array(dark, dtype=np.float64) - 1.0
        return np.asarray(np.hstack([low, low + 1.0]) * board.square_m)
    charuco, markers = _charuco(board), []
    for number, corners in zip(charuco.getIds().ravel(), charuco.getObjPoints(), strict=True):
        markers.append(_marker_cells(board, int(number), np.asarray(corners)[:, :2]))
    columns, rows = board.squares
    # OpenCV's boards have a dark square at the upper left corner, legacy ones at the lower left.
    light = 1 if board.legacy and rows % 2 == 0 else 0
    dark = [(x, y) for y in range(rows) for x in range(columns) if (x + y) % 2 == light]
    low = np.array(dark, dtype=np.float64) * board.square_m
    cells = np.concatenate([np.hstack([low, low + board.square_m]), *markers])
    return np.asarray(cells - board.square_m)


def find_charuco(grey: UInt8, board: CalibrationBoard) -> tuple[Int32, Float64]:
    """Find the inner corners of a ChArUco board, which may be partly visible.

    Returns:
        int32 (N,), indices into `CalibrationBoard.corners_m`, and float64 (N, 2), pixels before
        refinement.
    """
    corners, numbers, *_ = cv2.aruco.CharucoDetector(_charuco(board)).detectBoard(grey)
    if numbers is None or len(numbers) == 0:
        return np.zeros(0, dtype=np.int32), np.zeros((0, 2))
    return (
        np.asarray(numbers, dtype=np.int32).ravel(),
        np.asarray(corners, dtype=np.float64).reshape(-1, 2),
    )


def find_markers(grey: UInt8, dictionary: str) -> Int32:
    """Return int32 (N,), ids of the markers of a dictionary found in an image."""
    detector = cv2.aruco.ArucoDetector(_dictionary(dictionary))
    numbers = detector.detectMarkers(grey)[1]
    return np.zeros(0, np.int32) if numbers is None else np.asarray(numbers, np.int32).ravel()


def marker_count(board: CalibrationBoard) -> int:
    """Return the number of markers on a ChArUco board."""
    columns, rows = board.squares
    return columns * rows // 2


def _dictionary(name: str) -> Any:
    number = getattr(cv2.aruco, f"{_PREFIX}{name}", None)
    if number is None:
        raise SettingsError(
            "unknown marker dictionary", got=name, expected=", ".join(dictionary_names())
        )
    return cv2.aruco.getPredefinedDictionary(number)


@lru_cache(maxsize=4)
def _charuco(board: CalibrationBoard) -> Any:
    dictionary = _dictionary(board.dictionary)
    if len(dictionary.bytesList) < marker_count(board):
        raise SettingsError(
            "dictionary has too few markers for the board",
            got=f"{board.dictionary.lower()} with {len(dictionary.bytesList)}",
            expected=f"at least {marker_count(board)}",
        )
    size = (board.columns, board.rows)
    charuco = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
    charuco.setLegacyPattern(board.legacy)
    return charuco


def _marker_cells(board: CalibrationBoard, number: int, corners: Float64) -> Float64:
    """Return float64 (M, 4), dark cells of the marker with the given corners (4, 2), metres."""
    dictionary = _dictionary(board.dictionary)
    cells = dictionary.markerSize + 2
    bits = cv2.aruco.generateImageMarker(dictionary, number, cells)
    rows, columns = np.nonzero(bits == 0)
    step = board.marker_m / cells
    low = corners.min(axis=0) + np.stack([columns, rows], axis=1) * step
    return np.asarray(np.hstack([low, low + step]))
