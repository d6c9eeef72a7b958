"""Kinds of calibration boards: how each is found in an image to subpixel accuracy, and drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np

from recon.core.errors import SettingsError
from recon.core.values.arrays import Float64, Int32, UInt8
from recon.core.values.board import CalibrationBoard
from recon.rig.calibrate.bundle import Sighting

Inner = tuple[int, int]
_SEARCH_WIDTH_PX: Final = 1280  # corners are refined at full resolution
# Half the window of the subpixel search, relative to a square: as wide as possible without another
# corner in it; and the part of the free space around the corners of tags.
WINDOW: Final = 0.33
_FREE: Final = 0.8
_SMALLEST_WINDOW_PX: Final = 2
_LARGEST_WINDOW_PX: Final = 25
_SUB_PIXEL: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-5)
_CHESS_FLAGS: Final = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
SLOW_FLAGS: Final = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
_FEWEST_CORNERS: Final = 8
_LOST: Final = 1.5  # corners that refinement moves farther, relative to its window, stay
_PREFIX: Final = "DICT_"
_TAG_BITS: Final = 6  # along a side of tag36h11
# Bits of another tag of the family differ in 11 of 36, and correlate by at most 1 - 2 * 11 / 36;
# those of what is no tag by less than 0.6, in all but 1 of 10,000 cases.
_SAME_TAG: Final = 0.6
# Small and blurred tags are seen in an enlarged image, sharpened by what blur of this width takes.
_LARGEST_SCALE: Final = 3.0
_ENLARGED_PX: Final = 2560  # its largest width
_SHARPER: Final = 4.0
_BLUR_PX: Final = 1.5
_ROUND: Final = 2.0 * math.pi * np.arange(64) / 64


def find_board(grey: UInt8, board: CalibrationBoard) -> Sighting | None:
    """Find a board, or a part of one with markers; None if fewer than 8 corners, or on one line."""
    pattern = PATTERNS[board.kind]
    found = pattern.find(grey, board)
    if found is None or len(found[0]) < min(_FEWEST_CORNERS, len(board.corners_m)):
        return None
    numbers, pixels, cleaned = found
    corners_m = board.corners_m[numbers]
    flat = corners_m[:, :2] - corners_m[:, :2].mean(axis=0)
    if np.linalg.matrix_rank(flat, tol=1e-9 * board.square_m) < 2:
        return None
    reach_px = pattern.free_m(board) * _scales(corners_m, pixels)
    return Sighting(numbers, corners_m, pattern.refine(cleaned, pixels, reach_px))


def _scales(corners_m: Float64, pixels: Float64) -> Float64:
    """Return float64 (N,), pixels per metre around each corner, in the direction with the least."""
    apart_m, apart_px = (each[None] - each[:, None] for each in (corners_m[:, :2], pixels))
    square = (apart_m**2).sum(axis=2)
    near = np.argsort(square, axis=1, kind="stable")[:, 1:7]
    by_m, by_px = (np.take_along_axis(each, near[..., None], 1) for each in (apart_m, apart_px))
    by_m = by_m / np.take_along_axis(square, near, 1)[..., None]
    # The affine map that fits the way to the nearest corners, each weighted by its distance.
    A = np.linalg.pinv(by_m.transpose(0, 2, 1) @ np.take_along_axis(apart_m, near[..., None], 1))
    singular = np.linalg.svd(A @ by_m.transpose(0, 2, 1) @ by_px, compute_uv=False)
    return np.where(singular[:, 1] > 1e-3 * singular[:, 0], singular[:, 1], singular[:, 0])


def refine_corners(grey: UInt8, pixels: Float64, reach_px: Float64) -> Float64:
    """Return corners (N, 2) refined in windows, whose half width (N,) is given in pixels."""
    halves = np.clip(np.rint(reach_px), _SMALLEST_WINDOW_PX, _LARGEST_WINDOW_PX).astype(int)
    refined = pixels.astype(np.float32)[:, None]
    for half in np.unique(halves):
        own = halves == half
        window = (int(half), int(half))
        refined[own] = cv2.cornerSubPix(grey, refined[own].copy(), window, (-1, -1), _SUB_PIXEL)
    moved = np.linalg.norm(refined[:, 0] - pixels, axis=1)
    return np.where((moved > _LOST * halves)[:, None], pixels, refined[:, 0]).astype(np.float64)


Found = tuple[Int32, Float64, UInt8]  # numbers and pixels of corners, and where to refine them


def find_chessboard(grey: UInt8, inner: Inner) -> Float64 | None:
    """Return float64 (N, 2), approximate inner corners row by row, or None."""
    scale = min(1.0, _SEARCH_WIDTH_PX / grey.shape[1])
    small = grey
    if scale != 1:
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found, corners = cv2.findChessboardCorners(small, inner, flags=_CHESS_FLAGS)
    if not found:
        # Slower and stricter about margins, but finds tilted and badly lit boards.
        found, corners = cv2.findChessboardCornersSB(small, inner, flags=SLOW_FLAGS)
    if not found:
        return None
    return np.asarray((np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5)


def _find_chess(grey: UInt8, board: CalibrationBoard) -> Found | None:
    pixels = find_chessboard(grey, board.inner)
    return None if pixels is None else (np.arange(len(pixels), dtype=np.int32), pixels, grey)


def _find_charuco(grey: UInt8, board: CalibrationBoard) -> Found | None:
    corners, numbers, markers, _ = cv2.aruco.CharucoDetector(charuco(board)).detectBoard(grey)
    if numbers is None:
        return None
    # Without its markers this is a chessboard, whose corners have wider windows. They are painted
    # over to the middle of the gap around them, in the white of their square.
    plain, gap = grey.copy(), board.square_m / board.marker_m - 1
    for marker in markers:
        middle = marker.reshape(4, 2).mean(axis=0)
        square, paint = (middle + (marker.reshape(4, 2) - middle) * (1 + n * gap) for n in (1, 0.5))
        x, y, width, height = cv2.boundingRect(square.astype(np.float32))
        white = np.quantile(grey[max(y, 0) : y + height, max(x, 0) : x + width], 0.9)
        cv2.fillConvexPoly(plain, np.rint(16 * paint).astype(np.int32), float(white), shift=4)
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return np.asarray(numbers, dtype=np.int32).ravel(), pixels, plain


def _find_tags(grey: UInt8, board: CalibrationBoard) -> Found | None:
    tags = _TagSearch(grey, board).find()
    if not tags:
        return None
    numbers = np.concatenate([_tag_corners(tag, board) for tag in tags])
    return numbers.astype(np.int32), np.concatenate(list(tags.values())), grey


class _TagSearch:
    """The tags of a board that are found in an image, each with the likeness of its bits."""

    def __init__(self, grey: UInt8, board: CalibrationBoard) -> None:
        self._grey, self._board = grey, board
        self._sharp = _sharpened(grey, 1.0)
        self._all = set(range(board.columns * board.rows))
        self._found: dict[int, tuple[float, Float64]] = {}

    def find(self) -> dict[int, Float64]:
        """Return corners (4, 2) of tags, px: lower left and right, upper left and right."""
        # The squares between tags touch their corners, which hides most tags from OpenCV. Where one
        # is known, its neighbours are looked for where they must be.
        enlarged = min(_LARGEST_SCALE, _ENLARGED_PX / self._grey.shape[1])
        for scale in (1.0, enlarged):
            large = self._grey if scale == 1 else _sharpened(self._grey, scale)
            corners, ids, _ = _tag_detector(_border(self._board)).detectMarkers(large)
            for tag, quad in zip([] if ids is None else ids.ravel().tolist(), corners, strict=True):
                pixels = quad.reshape(4, 2)[[1, 0, 2, 3]].astype(np.float64)
                self._keep(tag, (pixels + 0.5) / scale - 0.5)
            self._grow()
            if len(self._found) == len(self._all):
                break
        alone = {tag for tag in self._found if not self._near(tag)}
        kept = self._found if len(alone) == len(self._found) else set(self._found) - alone
        return {tag: self._found[tag][1] for tag in sorted(kept)}

    def _near(self, tag: int) -> list[int]:
        """Return the tags that were found around one."""
        row, column = divmod(tag, self._board.columns)
        rows = range(max(row - 1, 0), row + 2)
        columns = range(max(column - 1, 0), min(column + 2, self._board.columns))
        around = [r * self._board.columns + c for r in rows for c in columns]
        return [n for n in around if n in self._found and n != tag]

    def _grow(self) -> None:
        fresh = bool(self._found)
        while fresh:
            fresh = False
            near = {tag: self._near(tag) for tag in self._all - set(self._found)}
            for tag, known in near.items():
                fresh |= bool(known) and self._keep(tag, self._guess(tag, known))

    def _guess(self, tag: int, near: list[int]) -> Float64:
        """Return corners (4, 2) of a tag beside known ones; zeros = not known."""
        flat = np.concatenate([_tag_m(n, self._board) for n in near])
        pixels = np.concatenate([self._found[n][1] for n in near])
        H, _ = cv2.findHomography(flat, pixels)
        wanted = _tag_m(tag, self._board)
        guess = np.zeros((4, 2)) if H is None else cv2.perspectiveTransform(wanted[None], H)[0]
        return np.asarray(guess, dtype=np.float64)

    def _outside(self, pixels: Float64) -> bool:
        height, width = self._grey.shape
        return not ((pixels >= 1) & (pixels <= (width - 2, height - 2))).all()  # NaN, too

    def _keep(self, tag: int, guess: Float64) -> bool:
        """Add a tag if its bits and corners are read at its refined corners."""
        board = self._board
        if tag not in self._all or self._outside(guess):
            return False
        quad_m, free_m = _tag_m(tag, board), _free_of_tags(board)
        quad = refine_corners(self._grey, guess, free_m * _scales(quad_m, guess))
        H = cv2.getPerspectiveTransform(quad_m.astype(np.float32), quad.astype(np.float32))

        def read(places_m: Float64) -> Float64:
            at = cv2.perspectiveTransform(places_m.reshape(-1, 1, 2), H).astype(np.float32)
            return np.asarray(
                cv2.remap(self._sharp, at, None, cv2.INTER_LINEAR), np.float64
            ).ravel()

        middles = np.mgrid[0:_TAG_BITS, 0:_TAG_BITS][::-1].reshape(2, -1).T - (_TAG_BITS - 1) / 2
        bit_m = board.marker_m / (_TAG_BITS + 2 * _border(board))
        seen = read(quad_m.mean(axis=0) + middles * bit_m)
        shown = cv2.aruco.generateImageMarker(dictionary(board.dictionary), tag, _TAG_BITS + 2)
        bits = shown[-2:0:-1, -2:0:-1].ravel() > 0
        likeness = float(np.corrcoef(seen, bits)[0, 1]) if np.ptp(seen) else 0.0
        # The border of a tag is dark, and the paper beside its corners light. Where a corner is
        # that of the square beside it, the border leaves the tag.
        middle = (seen[bits].mean() + seen[~bits].mean()) / 2
        outward = np.sign(quad_m - quad_m.mean(axis=0)) * free_m / 2
        beside = np.stack([read(quad_m + outward * turn) for turn in ((1, -1), (-1, 1))])
        border = np.linspace(quad_m - outward, (quad_m - outward)[[1, 3, 0, 2]], 5)[:-1]
        fits = (read(border) < middle).all() and (beside > middle).all()
        better = bool(fits) and likeness > max(_SAME_TAG, self._found.get(tag, (0.0,))[0])
        if better:
            self._found[tag] = likeness, quad
        return better


def _sharpened(grey: UInt8, scale: float) -> UInt8:
    large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    smooth = cv2.GaussianBlur(large, (0, 0), _BLUR_PX * scale)
    return np.asarray(cv2.addWeighted(large, 1 + _SHARPER, smooth, -_SHARPER, 0), dtype=np.uint8)


def _tag_corners(tag: int, board: CalibrationBoard) -> Int32:
    """Return the numbers of a tag's corners: lower left and right, upper left and right."""
    row, column = divmod(tag, board.columns)
    first = (2 * row * board.columns + column) * 2
    return np.array([0, 1, 2 * board.columns, 2 * board.columns + 1], dtype=np.int32) + first


def _tag_m(tag: int, board: CalibrationBoard) -> Float64:
    """Return float64 (4, 2), corners of a tag on the board, metres."""
    return board.corners_m[_tag_corners(tag, board), :2]


def _free_of_tags(board: CalibrationBoard) -> float:
    """Return how far from a corner nothing but its four quadrants is, metres, less some margin."""
    border_m = board.marker_m * _border(board) / (_TAG_BITS + 2 * _border(board))
    return _FREE * min(border_m, board.square_m - board.marker_m)


def _border(board: CalibrationBoard) -> int:
    """Return the width of the dark border of tags, bits."""
    return 1 if board.legacy else 2


@lru_cache(maxsize=2)
def _tag_detector(border: int) -> Any:
    settings = cv2.aruco.DetectorParameters()
    settings.markerBorderBits = border
    settings.errorCorrectionRate = 1.0  # what is no tag is found out by its bits and corners
    return cv2.aruco.ArucoDetector(dictionary("APRILTAG_36H11"), settings)


def _find_circles(grey: UInt8, board: CalibrationBoard) -> Found | None:
    blobs = cv2.SimpleBlobDetector.Params()
    blobs.maxArea = grey.size / len(board.corners_m)
    blobs.minConvexity = 0.8
    how = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
    detector = cv2.SimpleBlobDetector.create(blobs)
    for flags in (how, how | cv2.CALIB_CB_CLUSTERING):  # it finds others, for wide lenses fewer
        done, centres = cv2.findCirclesGrid(grey, board.inner, flags=flags, blobDetector=detector)
        if done:
            pixels = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
            return np.arange(len(pixels), dtype=np.int32), pixels, grey
    return None


def _refine_circles(grey: UInt8, pixels: Float64, reach_px: Float64) -> Float64:
    """Return the centroids (N, 2) of dark discs, each pixel weighted by how dark it is."""
    refined = pixels.copy()
    for number, (centre, reach) in enumerate(zip(pixels, reach_px, strict=True)):
        low = np.maximum(np.floor(centre - reach).astype(int), 0)
        part = grey[
            low[1] : math.ceil(centre[1] + reach) + 1, low[0] : math.ceil(centre[0] + reach) + 1
        ]
        y, x = np.mgrid[0 : part.shape[0], 0 : part.shape[1]]
        dark, light = np.quantile(part, (0.05, 0.95))
        weight = np.clip((light - part) / max(light - dark, 1.0), 0.0, 1.0)
        weight[np.hypot(x + low[0] - centre[0], y + low[1] - centre[1]) > reach] = 0.0
        weight[weight < 0.2] = 0.0  # noise of the paper
        if weight.any():
            place = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
            refined[number] = low + place
    return np.asarray(refined)


def dark_polygons(board: CalibrationBoard) -> Float64:
    """Return float64 (M, K, 2), outlines of what is dark, metres from the first corner."""
    return np.asarray(PATTERNS[board.kind].draw(board))


def _boxes(low: Float64, size: float | Float64) -> Float64:
    """Return float64 (M, 4, 2), outlines of boxes with a lower corner (M, 2) and a side."""
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return np.asarray(low[:, None] + unit * np.reshape(size, (-1, 1, 1)))


def _dark_squares(board: CalibrationBoard) -> Float64:
    columns, rows = board.squares
    # OpenCV's boards have a dark square at the upper left corner, legacy ones at the lower left.
    light = 1 if board.legacy and rows % 2 == 0 else 0
    dark = [(x, y) for y in range(rows) for x in range(columns) if (x + y) % 2 == light]
    return _boxes((np.array(dark, dtype=np.float64) - 1.0) * board.square_m, board.square_m)


def _dark_charuco(board: CalibrationBoard) -> Float64:
    drawn = charuco(board)
    parts = [_dark_squares(board)]
    for number, corners in zip(drawn.getIds().ravel(), drawn.getObjPoints(), strict=True):
        first = np.asarray(corners)[:, :2].min(axis=0) - board.square_m
        parts.append(_cells(board, int(number), first, 1))
    return np.concatenate(parts)


def _dark_tags(board: CalibrationBoard) -> Float64:
    gap_m, parts = board.square_m - board.marker_m, []
    for tag in range(board.columns * board.rows):
        corners = _tag_m(tag, board)
        parts.append(_cells(board, tag, corners[2], _border(board), turned=True))
        parts.append(
            _boxes(corners + gap_m * np.array([[-1, 0], [0, 0], [-1, -1], [0, -1]]), gap_m)
        )
    return np.concatenate(parts)


def _cells(
    board: CalibrationBoard, number: int, first: Float64, border: int, *, turned: bool = False
) -> Float64:
    """Return the dark cells of a marker whose upper left corner is given."""
    known = dictionary(board.dictionary)
    side = known.markerSize + 2 * border
    bits = cv2.aruco.generateImageMarker(known, number, side, borderBits=border)
    rows, columns = np.nonzero((bits[::-1, ::-1] if turned else bits) == 0)
    step = board.marker_m / side
    return _boxes(first + np.stack([columns, rows], axis=1) * step, step)


def _dark_circles(board: CalibrationBoard) -> Float64:
    ring = board.marker_m / 2 * np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=1)
    return np.asarray(board.corners_m[:, None, :2] + ring)


def dictionaries() -> list[str]:
    """Return the names of OpenCV's marker dictionaries."""
    return sorted({n[len(_PREFIX) :].upper() for n in dir(cv2.aruco) if n.startswith(_PREFIX)})


def dictionary(name: str) -> Any:
    """Return OpenCV's marker dictionary of a name."""
    number = getattr(cv2.aruco, f"{_PREFIX}{name}", None)
    if number is None:
        known = ", ".join(dictionaries())
        raise SettingsError("unknown marker dictionary", got=name, expected=known)
    return cv2.aruco.getPredefinedDictionary(number)


@lru_cache(maxsize=4)
def charuco(board: CalibrationBoard) -> Any:
    """Return a board as OpenCV has it."""
    known = dictionary(board.dictionary)
    if len(known.bytesList) < math.prod(board.squares) // 2:
        raise SettingsError(
            "dictionary has too few markers for the board",
            got=f"{board.dictionary.lower()} with {len(known.bytesList)}",
            expected=f"at least {math.prod(board.squares) // 2}",
        )
    size = (board.columns, board.rows)
    drawn = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, known)
    drawn.setLegacyPattern(board.legacy)
    return drawn


@dataclass(frozen=True)
class Pattern:
    """How boards of one kind are found and drawn; see `recon.core.values.board` for the corners."""

    find: Callable[[UInt8, CalibrationBoard], Found | None]
    draw: Callable[[CalibrationBoard], Float64]
    free_m: Callable[[CalibrationBoard], float]  # what may be looked at around a corner
    refine: Callable[[UInt8, Float64, Float64], Float64] = refine_corners


def _around_square(board: CalibrationBoard) -> float:
    return WINDOW * board.square_m


def _around_circle(board: CalibrationBoard) -> float:
    nearest_m = board.square_m * (2**0.5 if board.kind == "acircles" else 1.0)
    return min(0.75 * board.marker_m, nearest_m - board.marker_m / 2)


PATTERNS: Final = {
    "chess": Pattern(_find_chess, _dark_squares, _around_square),
    "charuco": Pattern(_find_charuco, _dark_charuco, _around_square),
    "aprilgrid": Pattern(_find_tags, _dark_tags, _free_of_tags),
    "circles": Pattern(_find_circles, _dark_circles, _around_circle, _refine_circles),
    "acircles": Pattern(_find_circles, _dark_circles, _around_circle, _refine_circles),
}
