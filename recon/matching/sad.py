"""The SAD matcher: local windows, compared by the sum of absolute differences."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final, Literal

import cv2
import numpy as np
from pydantic import Field, field_validator, model_validator
from typing_extensions import Self

from recon.errors import MatchingError
from recon.kernels.minima import empty_minima
from recon.kernels.refine import (
    EQUIANGULAR,
    NO_FIT,
    PARABOLA,
    Rules,
    empty_refined,
    refine_minima,
)
from recon.kernels.sad import Search, mirror_right, sad_minima
from recon.kernels.speckle import find_speckles
from recon.matching.fill import fill_holes
from recon.settings import Settings
from recon.structures import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.structures.arrays import Float32, UInt8

_FITS: Final = {"none": NO_FIT, "equiangular": EQUIANGULAR, "parabola": PARABOLA}

_GAIN_OF_SOBEL: Final = 8.0
"""A 3×3 Sobel filter answers a slope of one grey level per pixel with 8."""


class SadSettings(Settings):
    """Settings of the SAD matcher."""

    window_px: int = Field(default=11, ge=1, le=61, description="Width of the window; odd.")
    window_height_px: int = Field(default=11, ge=1, le=61, description="Height of the window; odd.")
    window_slant: float = Field(
        default=1 / 3,
        ge=-1.0,
        le=1.0,
        description="Disparity per row of a second window, which competes with the upright one "
        "at each pixel; 0 = none. On level ground it is baseline / camera height.",
    )
    min_disparity_px: int = Field(
        default=0, ge=-4096, le=4096, description="First disparity searched; may be negative."
    )
    ndisp: int | None = Field(
        default=None,
        ge=3,
        le=4096,
        description="Number of disparities searched. None: what the calibration says, or else a "
        "tenth of the image width, rounded up to a multiple of 16.",
    )
    prefilter: Literal["sobel", "none"] = Field(
        default="sobel", description="What is compared: horizontal gradients, or grey levels."
    )
    prefilter_cap: int = Field(
        default=31,
        ge=1,
        le=127,
        description="Gradients (Sobel units) are clipped to plus or minus this.",
    )
    cost_cap: int = Field(
        default=20,
        ge=1,
        le=255,
        description="Largest cost of one pixel; limits what an outlier or an edge can do.",
    )
    subpixel: Literal["equiangular", "parabola", "none"] = Field(
        default="equiangular", description="How the minimum is placed between whole disparities."
    )
    uniqueness_percent: int = Field(
        default=2,
        ge=0,
        le=100,
        description="By how much the second best cost must exceed the best; 0 = no check.",
    )
    min_texture: float = Field(
        default=0.1,
        ge=0.0,
        le=255.0,
        description="Least mean horizontal gradient in the window, grey levels per pixel.",
    )
    left_right_px: int | None = Field(
        default=1,
        ge=0,
        le=255,
        description="Largest difference between the left and the right view; None = no check.",
    )
    speckle_size_px: int = Field(
        default=50, ge=0, description="Regions of fewer pixels are removed; 0 = keep all."
    )
    speckle_range_px: float = Field(
        default=1.0,
        gt=0.0,
        description="Largest step of disparity between neighbours of one region.",
    )
    median_px: Literal[0, 3, 5] = Field(
        default=0,
        description="Each disparity becomes the median of a square of this width around it, holes "
        "filled for that from the row; 0 = as measured.",
    )
    sigma_floor_px: float = Field(
        default=0.1,
        gt=0.0,
        le=2.0,
        description="Smallest standard deviation that a disparity is given.",
    )

    @field_validator("window_px", "window_height_px")
    @classmethod
    def _is_odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError("a window needs a pixel in its middle: an odd number")
        return value

    @model_validator(mode="after")
    def _costs_fit(self) -> Self:
        if self.window_px * self.window_height_px * self.cost_cap >= 65535:
            raise ValueError("window_px x window_height_px x cost_cap must stay below 65535")
        return self


class SadMatcher:
    """Compares windows of gradients and checks what it finds; a `Matcher`.

    Every pixel is searched, those at the left border as far as the right picture reaches.

    Args:
        settings: What to search and what to believe.
        threads: Strips of rows worked on at once, all cores by default. The result does not
            depend on it.
    """

    def __init__(self, settings: SadSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = max(1, threads or os.cpu_count() or 1)

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            MatchingError: No disparity of the range lies within the picture.
        """
        search, rules = self._plan(pair.camera)
        texture = _texture(pair, self._settings)
        left = _prefiltered(pair.left, self._settings)
        mirrored = mirror_right(_prefiltered(pair.right, self._settings), search)
        minima = empty_minima(*left.shape)
        refined = empty_refined(*left.shape)

        def strip(first: int, end: int) -> None:
            sad_minima(left, mirrored, search, first, end, minima)
            refine_minima(minima, texture, rules, first, end, refined)

        _in_strips(strip, len(left), self._threads)
        found = self._without_speckles(Disparity(*refined))
        return _smoothed(found, self._settings.median_px)

    def _plan(self, camera: RectifiedCamera) -> tuple[Search, Rules]:
        s = self._settings
        ndisp = s.ndisp or camera.ndisp or usual_ndisp(camera.width_px)
        last = s.min_disparity_px + ndisp - 1
        if s.min_disparity_px >= camera.width_px or last <= -camera.width_px:
            raise MatchingError(
                "no disparity of the range lies within the picture",
                got=f"{s.min_disparity_px} to {last} px",
                expected=f"some within {1 - camera.width_px} to {camera.width_px - 1} px",
                hint="check min_disparity_px and ndisp",
            )
        radius, rows_radius = s.window_px // 2, s.window_height_px // 2
        search = Search(ndisp, s.min_disparity_px, radius, rows_radius, s.cost_cap, s.window_slant)
        rules = Rules(
            ndisp=ndisp,
            minimum=s.min_disparity_px,
            fit=_FITS[s.subpixel],
            texture=s.min_texture,
            uniqueness=s.uniqueness_percent,
            left_right=-1 if s.left_right_px is None else s.left_right_px,
            window_pixels=s.window_px * s.window_height_px,
            sigma_floor_px=s.sigma_floor_px,
        )
        return search, rules

    def _without_speckles(self, disparity: Disparity) -> Disparity:
        s = self._settings
        if s.speckle_size_px < 2:
            return disparity
        small = find_speckles(disparity.values, s.speckle_range_px, s.speckle_size_px)
        return disparity.reject(small, Reason.SPECKLE)


def _smoothed(disparity: Disparity, median_px: int) -> Disparity:
    """The disparity with medians for values; what has none gets none."""
    if median_px == 0 or not disparity.valid.any():
        return disparity
    filled = np.nan_to_num(fill_holes(disparity.values))
    medians = cv2.medianBlur(filled, median_px)
    values = np.where(disparity.valid, medians, np.float32(np.nan))
    return replace(disparity, values=values)


def usual_ndisp(width_px: int) -> int:
    """A number of disparities that suits most rigs: a tenth of the width, in steps of 16."""
    return 16 * max(1, -(-width_px // 160))


def _prefiltered(image: UInt8, settings: SadSettings) -> UInt8:
    """What the windows compare: uint8 (H, W)."""
    if settings.prefilter == "none":
        return image
    cap = settings.prefilter_cap
    gradient = cv2.Sobel(image, cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.clip(gradient, -cap, cap) + cap, dtype=np.uint8)


def _texture(pair: RectifiedPair, settings: SadSettings) -> Float32:
    """Mean horizontal gradient in the window, grey levels per pixel; NaN = no picture."""
    gradient = cv2.Sobel(pair.left, cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE)
    size = (settings.window_px, settings.window_height_px)
    total = cv2.boxFilter(
        np.abs(gradient).view(np.uint16),
        cv2.CV_32F,
        size,
        normalize=False,
        borderType=cv2.BORDER_REPLICATE,
    )
    mean = total * np.float32(1 / (_GAIN_OF_SOBEL * size[0] * size[1]))
    if pair.valid is not None:
        mean[~pair.valid] = np.nan
    return np.asarray(mean, dtype=np.float32)


def _in_strips(work: Callable[[int, int], None], rows: int, threads: int) -> None:
    """Do all rows, in one strip per thread."""
    edges = np.linspace(0, rows, min(threads, rows) + 1).astype(int).tolist()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, edges[:-1], edges[1:]))
