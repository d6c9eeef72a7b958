"""What all matchers over a range of disparities share: range, checks, gradients, memory."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Annotated, Any, Final, Generic, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from recon.core.errors import MatchingError, SettingsError
from recon.core.settings import Settings
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Bool, Float32, UInt8
from recon.stereo.kernels.finish import average_opposite, find_speckles
from recon.stereo.kernels.refine import ODDS, Refined, Rules, reject

LEFT_RIGHT_PX: Final = 1  # largest difference of disparities of the left and the right view
_SIGMA_FLOOR_PX: Final = 0.1  # of a disparity at least: noise is not all that makes it wrong
_SPECKLE_SIZE_PX: Final = 50  # regions of fewer pixels are removed
_SPECKLE_STEP_PX: Final = 1.0  # largest step of disparity between neighbours of one region
# Each disparity becomes the mean of the pairs of opposite neighbours, in a square of this width,
# that lie on its surface.
_AVERAGE_PX: Final = 7
_SAME_SURFACE_PX: Final = 1.0  # between neighbours that differ by more may be a step of depth


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("a window needs a pixel in its middle: an odd number")
    return value


OddInt = Annotated[int, AfterValidator(_odd)]  # a width with a pixel in its middle


class SearchSettings(Settings):
    """What is searched, in which windows, and what is done with the holes; for all matchers."""

    min_disparity_px: int = Field(0, ge=-4096, le=4096)
    """First disparity searched; negative for cameras that converge."""
    ndisp: int | None = Field(None, ge=3, le=4096)
    """Number of disparities searched (OpenCV: rounded up to a multiple of 16). none = what the
    calibration says, or else as far as each pair needs. Time and memory grow with it; what is
    nearer than its last disparity is not found."""
    window_px: OddInt | None = Field(None, ge=1, le=255)
    """Edge of the square window; odd. none = 11 of `sad` (at most 55), 5 of `sgm` (at most 31), 9
    of `opencv-bm` (at least 5), 3 of `opencv-sgbm`; `fine` has none. Smaller keeps thin things and
    sharp edges, larger is denser where texture is weak."""
    uniqueness_percent: int | None = Field(None, ge=0, le=100)
    """By how much the second best cost must exceed the best; 0 = no check. none = 2 of `sad`, 0 of
    `sgm` and `fine`; OpenCV's matchers have their own. Raise it where repeated structures (fences,
    tiles) leave wrong matches."""
    fill: bool | Literal["ours"] = False
    """Decide by the look of the image what windows cannot: take back what they gave to the wrong
    side of a step of depth, and infer what lies in a gap of a plane, marked as filled and kept
    apart from what was measured. Takes some tenths of a second per megapixel; false has what the
    windows found; ours = for `sad`, `sgm` and `fine`, not for OpenCV's matchers."""

    def window_within(self, usual_px: int, most_px: int) -> int:
        """Return the edge of the window of a matcher, which takes none wider than ``most_px``."""
        window_px = self.window_px or usual_px
        if window_px > most_px:
            what = "the window is too wide for this matcher"
            raise SettingsError(
                what, where="matching.window_px", got=window_px, expected=f"at most {most_px}"
            )
        return window_px

    def ndisp_for(self, camera: RectifiedCamera) -> int:
        """Return the number of disparities to search in the images of a camera."""
        return self.ndisp or camera.ndisp or usual_ndisp(camera.width_px)

    def ndisp_within(self, camera: RectifiedCamera) -> int:
        """Return the number of disparities to search, some of which lie within the image."""
        ndisp = self.ndisp_for(camera)
        last = self.min_disparity_px + ndisp - 1
        if self.min_disparity_px >= camera.width_px or last <= -camera.width_px:
            raise MatchingError(
                "no disparity of the range lies within the image",
                got=f"{self.min_disparity_px} to {last} px",
                expected=f"some within {1 - camera.width_px} to {camera.width_px - 1} px",
                hint="check min_disparity_px and ndisp",
            )
        return ndisp


def rules_of(
    settings: SearchSettings,
    ndisp: int,
    window_pixels: int,
    *,
    min_texture: float = 0.0,
    uniqueness: int = 0,
    odds: float = ODDS,
) -> Rules:
    """Return what the checks ask for, by the settings; ``uniqueness`` holds where they say none."""
    asked = settings.uniqueness_percent
    return Rules(
        ndisp=ndisp,
        minimum=settings.min_disparity_px,
        texture=min_texture,
        uniqueness=uniqueness if asked is None else asked,
        left_right=LEFT_RIGHT_PX,
        window_pixels=window_pixels,
        sigma_floor_px=_SIGMA_FLOOR_PX,
        odds=odds,
    )


def finish(refined: Refined, pool: Executor, threads: int, *, average: bool = True) -> Disparity:
    """Return the disparity without small regions, averaged; ``refined`` is overwritten."""
    small = find_speckles(refined.values, _SPECKLE_STEP_PX, _SPECKLE_SIZE_PX)
    # A plain number: to look up what an enumeration is takes numba 0.2 ms.
    reject(small, int(Reason.SPECKLE), refined)
    if not average:
        return Disparity(*refined)
    averages = np.empty_like(refined.values)
    given = refined.values, _AVERAGE_PX // 2, _SAME_SURFACE_PX
    run_kernel(pool, threads, len(averages), average_opposite, given, averages)
    return Disparity(*refined._replace(values=averages))


def in_strips(pool: Executor, threads: int, work: Callable[[range], None], rows: int) -> None:
    """Work on all rows, in one strip per thread; the calling thread takes the last one itself."""
    edges = np.linspace(0, rows, min(threads, rows) + 1).astype(int).tolist()
    *strips, last = itertools.starmap(range, itertools.pairwise(edges))
    handed_over = [pool.submit(work, strip) for strip in strips]
    work(last)
    for job in handed_over:
        job.result()


def run_kernel(
    pool: Executor, threads: int, rows: int, kernel: Callable[..., None], given: Any, *to: Any
) -> None:
    """Run a kernel on all rows, in strips, each from a row to a row.

    Its arguments are what is ``given``, these rows, and what it writes ``to``.
    """
    in_strips(pool, threads, lambda some: kernel(*given, some.start, some.stop, *to), rows)


def usual_ndisp(width_px: int) -> int:
    """Return a number of disparities that suits most rigs: a tenth of the width, in steps of 16."""
    return 16 * max(1, -(-width_px // 160))


T = TypeVar("T")


class ScratchPool(Generic[T]):
    """Lends scratch memory of one kind, also to several threads at once; keeps ``most`` pieces."""

    def __init__(self, make: Callable[..., T], most: int) -> None:
        self._make = make
        self._free: deque[tuple[tuple[Hashable, ...], T]] = deque(maxlen=most)

    @contextmanager
    def borrow(self, *size: Hashable) -> Iterator[T]:
        """Lend what ``make`` makes of a size for a ``with`` block; its content is undefined."""
        try:
            kept, scratch = self._free.pop()
        except IndexError:
            kept = None
        if kept != size:
            scratch = self._make(*size)
        yield scratch
        # Not after an error: another thread may still work in it.
        self._free.append((size, scratch))


class ResultPool:
    """Lends memory for results, which returns when the last reference to it is gone."""

    def __init__(self, most: int) -> None:
        self._free: deque[UInt8] = deque(maxlen=most)

    def lend(self, size_bytes: int) -> UInt8:
        """Return uint8 (size_bytes,), lent as long as it or a view of it is referenced."""
        try:
            block = self._free.pop()
        except IndexError:
            block = np.empty(0, np.uint8)
        if block.size != size_bytes:
            block = np.empty(size_bytes, np.uint8)
        return np.asarray(_Lent(block, self._free))


class _Lent:
    """The base of a lent array and of its views: its deletion returns the memory."""

    def __init__(self, block: UInt8, free: deque[UInt8]) -> None:
        self.__array_interface__ = block.__array_interface__
        self._block, self._free = block, free

    def __del__(self) -> None:
        self._free.append(self._block)


GRADIENT_CAP: Final = 31  # plus or minus; Sobel units that windows compare at most
_GAIN_OF_SOBEL: Final = 8.0  # a 3×3 Sobel filter answers a slope of one grey level per pixel with 8


def clipped_gradients(image: UInt8, rows: range) -> UInt8:
    """Return what windows compare in N rows of an image: clipped Sobel gradients plus the cap."""
    gradients = _sobel(image, rows)
    np.clip(gradients, -GRADIENT_CAP, GRADIENT_CAP, out=gradients)
    gradients += GRADIENT_CAP
    return gradients.astype(np.uint8)


def texture(pair: RectifiedPair, window_px: int, rows: range) -> Float32:
    """Return mean size of the horizontal gradient in the window around each pixel of the left view.

    float32 (N, W) of N consecutive rows, grey levels per pixel; NaN = no image.
    """
    reach = window_px // 2
    sizes = _sobel(pair.left, _around(rows, reach, len(pair.left)))
    sums = cv2.boxFilter(
        np.abs(sizes, out=sizes).view(np.uint16),
        cv2.CV_32F,
        (window_px, window_px),
        normalize=False,
        borderType=cv2.BORDER_REPLICATE,
    )
    above = min(reach, rows.start)
    mean = sums[above : above + len(rows)]
    mean *= np.float32(1 / (_GAIN_OF_SOBEL * window_px * window_px))
    return _where_seen(mean, pair.valid, rows)


def no_texture(width: int, valid: Bool | None, rows: range) -> Float32:
    """Return the same for checks that ask for none: 0, NaN where there is no image."""
    return _where_seen(np.zeros((len(rows), width), np.float32), valid, rows)


def _where_seen(mean: Float32, valid: Bool | None, rows: range) -> Float32:
    if valid is not None:
        mean[~valid[rows.start : rows.stop]] = np.nan
    return mean


def _around(rows: range, reach: int, height: int) -> range:
    return range(max(rows.start - reach, 0), min(rows.stop + reach, height))


def _sobel(image: UInt8, rows: range) -> NDArray[np.int16]:
    seen = _around(rows, 1, len(image))
    gradient = cv2.Sobel(
        image[seen.start : seen.stop], cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE
    )
    above = rows.start - seen.start
    return np.asarray(gradient[above : above + len(rows)], dtype=np.int16)
