"""While views of a board are recorded: what of them is missing, and what is wrong with the last."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

import cv2
import numpy as np

from recon.core.progress import stage
from recon.core.text import counted
from recon.core.values.arrays import Bool, UInt8
from recon.core.values.board import CalibrationBoard
from recon.rig.calibrate.bundle import Sighting
from recon.rig.calibrate.patterns import find_board
from recon.rig.calibrate.stereo import CELLS, cells_of
from recon.rig.calibrate.verdict import COVERED, ENOUGH_VIEWS, FAR_TO_NEAR, TILT_DEG, TILTED
from recon.rig.capture import CapturedPair
from recon.stereo.rectify.rectifier import noise_sigma, to_grey

_WANTED_PX: Final = 0.1  # error of a corner that lenses are fitted to
_SOFT_PX: Final = 3.0  # width of an edge; two pixels are those of a sharp image
_NEW: Final = 0.1  # a view is another one if it is moved or resized by this much of its size


class BoardGuide:
    """Looks at pairs one by one, and knows which views of a board there are."""

    def __init__(self, board: CalibrationBoard) -> None:
        self._board = board
        self._cells = np.zeros((2, *CELLS), dtype=bool)
        self._views: list[tuple[float, ...]] = []  # middle, scale and foreshortening of each

    def look(self, pair: CapturedPair) -> str:
        """Return what is wrong with a pair, else what is still missing."""
        greys = to_grey(pair.left), to_grey(pair.right)
        seen = [find_board(grey, self._board) for grey in greys]
        for side, grey, one in zip(("left", "right"), greys, seen, strict=True):
            if one is None:
                mean = f"mean grey level {grey.mean():.0f} of 255"
                return f"no board in the {side} image: all of it, lit and still ({mean})"
            if fault := fault_of(grey, one):
                return f"{side} image: {fault}"
        for cells, grey, one in zip(self._cells, greys, seen, strict=True):
            if one is not None:
                cells[cells_of(one.pixels, (grey.shape[1], grey.shape[0]))] = True
        if seen[0] is not None:
            self._add(seen[0])
        return self.advice()

    def _add(self, seen: Sighting) -> None:
        flat = seen.board_m[:, :2] - seen.board_m[:, :2].mean(axis=0)
        large, small = np.linalg.svd(np.linalg.lstsq(flat, seen.pixels, rcond=None)[0])[1]
        size_px = large * max(self._board.size_m)
        view = *(seen.pixels.mean(axis=0) / size_px), math.log(large), small / large
        if all(np.abs(np.subtract(view, other)).max() > _NEW for other in self._views):
            self._views.append(view)

    def advice(self) -> str:
        """Return what the views lack most, or that they are enough."""
        if not self._views:
            return "no view of the board yet"
        scales, foreshortened = np.array(self._views)[:, 2:].T
        tilted = float((foreshortened < math.cos(math.radians(TILT_DEG))).mean())
        covered = self._cells.mean(axis=(1, 2))
        side = int(np.argmin(covered))
        lacks = [f"{counted(len(self._views), 'view')} of {ENOUGH_VIEWS}"]
        if covered[side] < COVERED:
            where = _where(self._cells[side])
            lacks.append(f"show it {where} of the {('left', 'right')[side]} image")
        if tilted < TILTED:
            lacks.append(f"tilt it: {100 * tilted:.0f} % of the views are")
        if math.exp(np.ptp(scales)) < FAR_TO_NEAR:
            lacks.append("nearer and farther")
        enough = len(lacks) == 1 and len(self._views) >= ENOUGH_VIEWS
        return "enough views of the board" if enough else "; ".join(lacks)


def _where(cells: Bool) -> str:
    """Return the part of an image, of nine, in which the fewest cells have a corner."""
    parts = [
        (float(part.mean()), f"{row} {column}".strip())
        for columns, column in zip(np.array_split(cells, 3), ("left", "", "right"), strict=True)
        for part, row in zip(np.array_split(columns, 3, axis=1), ("top", "", "bottom"), strict=True)
    ]
    return f"at the {min(parts)[1] or 'middle'}"


def fault_of(grey: UInt8, seen: Sighting) -> str:
    """Return why corners are measured badly, from noise and contrast of the board; "" = well."""
    x, y, width, height = cv2.boundingRect(seen.pixels.astype(np.float32))
    part = grey[max(y, 0) : y + height, max(x, 0) : x + width]
    dark, light = np.quantile(part, (0.1, 0.9))
    contrast = max(float(light - dark), 1.0)
    noise = noise_sigma(part)
    smooth = cv2.GaussianBlur(part.astype(np.float32), (0, 0), 1.0)
    steepest = np.quantile(np.hypot(*np.gradient(smooth)), 0.99)
    # The smoothing by one pixel is taken off; an edge of noise has no width.
    edge_px = math.sqrt(max((contrast / max(float(steepest), 1e-3)) ** 2 - 2 * math.pi, 1.0))
    spacing_px = math.sqrt(width * height / len(seen.pixels))
    # Each of the four edges at a corner is placed by its pixels within a third of a square.
    error_px = edge_px * noise / contrast / math.sqrt(max(4 * spacing_px / 3, 1.0))
    if edge_px > min(_SOFT_PX, spacing_px / 3) + 1.0:
        return f"blurred, edges are {edge_px:.0f} px wide: focus, hold it still, expose shorter"
    if error_px > _WANTED_PX / 2:
        levels = f"board of {contrast:.0f} grey levels, noise of {noise:.1f}"
        return f"too dark, corners are off by {error_px:.2f} px ({levels}): more light"
    return ""


def guided(pairs: Iterable[CapturedPair], guide: BoardGuide) -> Iterator[CapturedPair]:
    """Yield pairs, and say what the guide has to say of one after the other, as it has time."""
    looking: Future[str] | None = None
    with ThreadPoolExecutor(1) as pool:
        for pair in pairs:
            if looking is None or looking.done():
                if looking is not None:
                    stage(looking.result())
                looking = pool.submit(guide.look, pair)
            yield pair
