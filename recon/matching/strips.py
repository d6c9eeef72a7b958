"""The search of a pair of pictures strip by strip, in memory that is kept."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial
from typing import Any

import numpy as np

from recon.kernels.half_windows import Search, empty_views, lay_out, make_room
from recon.kernels.minima import empty_minima
from recon.kernels.refine import REFINED_BYTES, Refined, Rules, refine_minima, refined_in
from recon.kernels.sad import sad_minima
from recon.kernels.tiles import Tiles
from recon.matching.rooms import Loans, Rooms
from recon.structures.arrays import Float32, UInt8


class StripSearch:
    """Searches pictures of one size, one strip of rows per thread.

    Args:
        prefilter: What is compared of a picture, uint8 (H, W).
        threads: Strips worked on at once. The result does not depend on it.
    """

    def __init__(self, prefilter: Callable[[UInt8], UInt8], threads: int) -> None:
        self._prefilter = prefilter
        self._threads = threads
        self._rooms = Rooms(make_room, threads)
        self._views = Rooms(empty_views, 1)
        self._minima = Rooms(empty_minima, 1)
        self._results = Loans(2)

    def find(
        self,
        pool: Executor,
        pictures: tuple[UInt8, UInt8],
        search: Search,
        tiles: Tiles,
        rules: Rules,
        texture: Callable[[], Float32],
    ) -> Refined:
        """Search, check and refine.

        Args:
            pool: Where to work.
            pictures: Left and right, uint8 (H, W).
            search: What is searched.
            tiles: Which candidates are offered where.
            rules: What the checks ask for.
            texture: float32 (H, W), of the left picture, made meanwhile.
        """
        height, width = pictures[0].shape
        results = self._results.lend(REFINED_BYTES * height * width)
        refined = refined_in(results, height, width)

        def lay(first: int, end: int) -> None:
            lay_out(left, right, search, first, end, views)

        def prefilter() -> list[UInt8]:
            return [self._prefilter(picture) for picture in pictures]

        def strip(first: int, end: int) -> None:
            with self._rooms.borrow(search, tiles.width) as room:
                sad_minima(views, search, tiles, first, end, room, minima)
            refine_minima(minima, enough, rules, first, end, refined)

        with (
            self._views.borrow(search, tiles.width, height, width) as views,
            self._minima.borrow(height, width) as minima,
        ):
            enough, (left, right) = self._together(pool, texture, prefilter)
            self._together(pool, *self._in_strips(lay, height))
            self._together(pool, *self._in_strips(strip, height))
        return refined

    def _in_strips(self, work: Callable[[int, int], None], rows: int) -> list[Callable[[], None]]:
        """The work on all rows, in one strip per thread."""
        edges = np.linspace(0, rows, min(self._threads, rows) + 1).astype(int).tolist()
        return [partial(work, first, end) for first, end in itertools.pairwise(edges)]

    def _together(self, pool: Executor, *jobs: Callable[[], Any]) -> list[Any]:
        """Do jobs at the same time, one of them in this thread: to hand it over takes time."""
        if self._threads == 1:
            return [job() for job in jobs]
        handed_over = [pool.submit(job) for job in jobs[:-1]]
        last = jobs[-1]()
        return [*(job.result() for job in handed_over), last]
