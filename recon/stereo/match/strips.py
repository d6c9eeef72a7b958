"""Local search of a pair of images in strips of rows, one per thread."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np

from recon.core.values.arrays import Float32, UInt8
from recon.stereo.kernels.half_windows import Search, empty_scratch, empty_views, lay_out
from recon.stereo.kernels.minima import empty_minima
from recon.stereo.kernels.refine import REFINED_BYTES, Refined, Rules, refine_minima, refined_in
from recon.stereo.kernels.sad import sad_minima
from recon.stereo.kernels.tiles import Tiles
from recon.stereo.match.scratch import ResultPool, ScratchPool


class StripSearch:
    """Searches pairs of images, one strip of rows per thread, and keeps its memory between pairs.

    Args:
        prefilter: Gives what windows compare in some rows of an image, uint8 (N, W).
        threads: Strips worked on at once. The result does not depend on it.
    """

    def __init__(self, prefilter: Callable[[UInt8, range], UInt8], threads: int) -> None:
        self._prefilter = prefilter
        self._threads = threads
        self._scratch = ScratchPool(empty_scratch, threads)
        self._views = ScratchPool(empty_views, 1)
        self._minima = ScratchPool(empty_minima, 1)
        self._results = ResultPool(2)

    def find(
        self,
        pool: Executor,
        images: tuple[UInt8, UInt8],
        search: Search,
        tiles: Tiles,
        rules: Rules,
        texture: Callable[[range], Float32],
    ) -> Refined:
        """Return search, check and refine.

        Args:
            pool: Where to work.
            images: Left and right, uint8 (H, W).
            search: What is searched.
            tiles: Which candidates are offered where.
            rules: What the checks ask for.
            texture: Gives the texture of some rows of the left image, float32 (N, W).
        """
        height, width = images[0].shape
        results = self._results.lend(REFINED_BYTES * height * width)
        refined = refined_in(results, height, width)

        def prepare(strip: range) -> None:
            left, right = (self._prefilter(image, strip) for image in images)
            lay_out(left, right, search, strip.start, views)

        def search_strip(strip: range) -> None:
            with self._scratch.borrow(search, tiles.width) as scratch:
                sad_minima(views, search, tiles, strip.start, strip.stop, scratch, minima)
            refine_minima(minima, texture(strip), rules, strip.start, strip.stop, refined)

        with (
            self._views.borrow(search, tiles.width, height, width) as views,
            self._minima.borrow(height, width) as minima,
        ):
            in_strips(pool, self._threads, prepare, height)
            in_strips(pool, self._threads, search_strip, height)
        return refined


def in_strips(pool: Executor, threads: int, work: Callable[[range], None], rows: int) -> None:
    """Work on all rows, in one strip per thread.

    Args:
        pool: Where to work on all strips but the last, which is left to the thread that calls:
            to hand work over takes time.
        threads: Most strips.
        work: What to do with some rows.
        rows: How many there are, at least 1.
    """
    edges = np.linspace(0, rows, min(threads, rows) + 1).astype(int).tolist()
    *strips, last = itertools.starmap(range, itertools.pairwise(edges))
    handed_over = [pool.submit(work, strip) for strip in strips]
    work(last)
    for job in handed_over:
        job.result()
