"""Stereo pairs, as recorded and rectified, their disparity, and images that come with theirs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from recon.core.errors import ShapeError
from recon.core.lazy import Shown
from recon.core.values.arrays import (
    Bool,
    Float32,
    UInt8,
    float_map,
    freeze,
    frozen_array,
    range_text,
    size_text,
)
from recon.core.values.camera import RectifiedCamera


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Two images taken at the same time, as delivered by a source.

    Attributes:
        left, right: uint8 (H, W) grey or (H, W, 3) RGB, of one size.
        timestamp_s: Time of exposure.
        index: Number of the frame in its source.
        name: Name shown to the user: the file name of the left image.
    """

    left: UInt8
    right: UInt8
    timestamp_s: float = 0.0
    index: int = 0
    name: str = ""

    def __repr__(self) -> str:
        kind = "colour" if self.left.ndim == 3 else "grey"
        name = f"{self.name!r}, " if self.name else ""
        return f"StereoPair({name}{size_text(self.left)} {kind}, frame {self.index})"

    def __post_init__(self) -> None:
        for side in ("left", "right"):
            image = getattr(self, side)
            colour = isinstance(image, np.ndarray) and image.ndim == 3
            freeze(self, side, np.uint8, (None, None, 3) if colour else (None, None))
        if self.left.shape[:2] != self.right.shape[:2]:
            raise ShapeError(
                "left and right image differ in size",
                where=self.name or None,
                got=f"left {size_text(self.left)}, right {size_text(self.right)}",
                hint="both cameras must record the same size",
            )


def join_pair(
    left: UInt8, right: UInt8, timestamp_s: float = 0.0, index: int = 0, name: str = ""
) -> StereoPair:
    """Join two images of equal size; if only one is in colour, the other is converted."""
    if left.ndim != right.ndim:
        left, right = in_colour(left), in_colour(right)
    return StereoPair(left, right, timestamp_s, index, name)


class Rectified:
    """The left view of a frame: what all but the matcher needs of a `RectifiedPair`."""

    left: UInt8
    camera: RectifiedCamera
    left_rgb: UInt8 | None
    valid: NDArray[np.bool_] | None
    timestamp_s: float
    index: int

    def __repr__(self) -> str:
        kind = "grey" if self.left_rgb is None else "colour"
        return f"{type(self).__name__}({kind}, frame {self.index}, {self.camera})"

    @property
    def colours(self) -> UInt8:
        """uint8 (H, W, 3): the left view in colour, or its grey values in all three channels."""
        return in_colour(self.left if self.left_rgb is None else self.left_rgb)

    @property
    def views(self) -> tuple[tuple[UInt8, UInt8], ...]:
        """The views there are images of, the left one first: in grey, and as they are shown."""
        return ((self.left, self.colours),)


@dataclass(frozen=True, eq=False, repr=False)
class RectifiedPair(Rectified):
    """Two grey images with aligned rows.

    Slices of other images are copied: kernels would be compiled anew for their layout.

    Attributes:
        left, right: uint8 (H, W), grey.
        left_rgb, right_rgb: uint8 (H, W, 3) colour, or None where the source is grey.
        valid: bool (H, W), False where rectification had no source pixel; None = all valid.
        timestamp_s, index: Those of the `StereoPair`.
    """

    left: UInt8
    right: UInt8
    camera: RectifiedCamera
    left_rgb: UInt8 | None = None
    right_rgb: UInt8 | None = None
    valid: NDArray[np.bool_] | None = None
    timestamp_s: float = 0.0
    index: int = 0

    def __post_init__(self) -> None:
        _freeze_view(self, "left", "left_rgb")
        _freeze_view(self, "right", "right_rgb")

    @property
    def views(self) -> tuple[tuple[UInt8, UInt8], ...]:
        right = self.right if self.right_rgb is None else self.right_rgb
        return (*super().views, (self.right, right))


def _freeze_view(view: Any, grey: str, rgb: str) -> None:
    size = (view.camera.height_px, view.camera.width_px)
    fields = {grey: (np.uint8, size), rgb: (np.uint8, (*size, 3)), "valid": (np.bool_, size)}
    for name, (dtype, shape) in fields.items():
        image = getattr(view, name)
        if isinstance(image, np.ndarray):
            object.__setattr__(view, name, np.ascontiguousarray(image))
        freeze(view, name, dtype, shape)


def in_colour(image: UInt8) -> UInt8:
    """Return an image (H, W, 3), grey values in all three channels."""
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


ASSUMED_CONFIDENCE: Final = 0.9  # confidence of matches whose matcher gives none
ASSUMED_SIGMA_PX: Final = 0.25  # standard deviation of matches whose matcher gives none


class Reason(IntEnum):
    """Why a pixel has no disparity, or how it got one: VALID = measured, FILLED = inferred."""

    VALID = 0
    LOW_TEXTURE = 1
    AMBIGUOUS = 2
    LEFT_RIGHT = 3
    OCCLUDED = 4
    OUT_OF_RANGE = 5
    BORDER = 6
    SPECKLE = 7
    EDGE = 8
    FILLED = 9


@dataclass(frozen=True, eq=False)
class Disparity(Shown):
    """Disparity map of the left view, with confidence and uncertainty.

    A pixel is *measured* (a match was found in the right view), *inferred* (nothing was found, or
    nothing sure, and it is given that of planes around it), or has no disparity. ``values`` and
    ``valid`` have both kinds; ``measured`` and ``inferred`` are masks, `only_measured` has one.

    Attributes:
        values: float32 (H, W), ``x_left - x_right`` in pixels, measured or inferred; NaN = neither.
        confidence: float32 (H, W) in [0, 1]; 0 where ``values`` is NaN.
        sigma_px: float32 (H, W), standard deviation of ``values``; NaN where ``values`` is NaN.
        reason: uint8 (H, W), a `Reason` for each pixel: VALID where it was measured, FILLED where
            it was inferred; another exactly where ``values`` is NaN.
    """

    values: Float32
    confidence: Float32
    sigma_px: Float32
    reason: UInt8

    def __post_init__(self) -> None:
        freeze(self, "values", np.float32, (None, None))
        for name, dtype in (("confidence", "f4"), ("sigma_px", "f4"), ("reason", "u1")):
            freeze(self, name, dtype, self.values.shape)
        if not np.array_equal(self.valid, self.measured | self.inferred):
            raise ShapeError(
                "Disparity.reason is FILLED or VALID where values is NaN, or the reverse"
            )

    @classmethod
    def from_values(
        cls,
        values: ArrayLike,
        *,
        confidence: ArrayLike = ASSUMED_CONFIDENCE,
        sigma_px: ArrayLike = ASSUMED_SIGMA_PX,
    ) -> Self:
        """Build a disparity map from a bare array (H, W), such as the output of another program.

        NaN, infinite, zero, negative and masked values are no match; their reason is AMBIGUOUS. The
        defaults are measured with OpenCV's matchers on MiddEval3 at quarter size: 90 to 92 % of
        the disparities they keep are within a pixel, and 68 % within a quarter.

        Args:
            values: (H, W) of any real dtype, ``x_left - x_right`` in pixels.
            confidence: A number or (H, W), in [0, 1]: how probable it is that a match is right.
            sigma_px: A number or (H, W), above 0: standard deviation of the matches, pixels.

        Raises:
            ShapeError: An array has the wrong shape or dtype, or a number is out of its range.
        """
        found = float_map("disparity", values)
        valid = np.isfinite(found) & (found > 0)
        sure, sigma = (
            np.broadcast_to(float_map(name, given, found.shape), found.shape)[valid]
            for name, given in (("confidence", confidence), ("sigma_px", sigma_px))
        )
        if not ((sure >= 0) & (sure <= 1)).all():
            raise ShapeError("confidence of a match is not a number in [0, 1]")
        if not ((sigma > 0) & np.isfinite(sigma)).all():
            raise ShapeError("sigma_px of a match is not a number above 0")
        return cls(
            values=np.where(valid, found, np.float32(np.nan)),
            confidence=_put(np.zeros(found.shape, np.float32), np.flatnonzero(valid), sure),
            sigma_px=_put(np.full(found.shape, np.nan, np.float32), np.flatnonzero(valid), sigma),
            reason=np.where(valid, np.uint8(Reason.VALID), np.uint8(Reason.AMBIGUOUS)),
        )

    def __repr__(self) -> str:
        ratios = (100 * kind.mean() for kind in (self.measured, self.inferred))
        text = "{:.1f} % measured, {:.1f} % inferred".format(*ratios)
        return f"Disparity({size_text(self.values)}, {range_text(self.values)}{text})"

    @cached_property
    def valid(self) -> Bool:
        """bool (H, W), where there is a disparity, measured or inferred; read-only."""
        return frozen_array("Disparity.valid", np.isfinite(self.values), np.bool_, (None, None))

    @cached_property
    def measured(self) -> Bool:
        """bool (H, W), where a match was found; read-only."""
        return self._of(Reason.VALID)

    @cached_property
    def inferred(self) -> Bool:
        """bool (H, W), where the disparity is that of planes around the pixel; read-only."""
        return self._of(Reason.FILLED)

    def _of(self, reason: Reason) -> Bool:
        # Compared with the enum member itself, numpy would use 64 bits and take ten times as long.
        mask = self.reason == np.uint8(reason)
        return frozen_array("Disparity.reason", mask, np.bool_, (None, None))

    def only_measured(self) -> Disparity:
        """Return what was measured alone; itself where nothing is inferred.

        Inferred pixels have no value then, and reason AMBIGUOUS: why nothing was found is not kept.
        """
        return self.reject(self.inferred, Reason.AMBIGUOUS) if self.inferred.any() else self

    def only_inferred(self) -> Disparity:
        """Return what was inferred alone; measured pixels have no value then, and AMBIGUOUS."""
        return self.reject(self.measured, Reason.AMBIGUOUS)

    @property
    def reason_ratios(self) -> dict[Reason, float]:
        """Fraction of the pixels, in [0, 1], for each reason that occurs; the largest first."""
        counts = np.bincount(self.reason.ravel(), minlength=len(Reason)).tolist()
        order = sorted(Reason, key=lambda reason: -counts[reason])
        return {reason: counts[reason] / self.reason.size for reason in order if counts[reason]}

    def reject(self, mask: Bool, reason: Reason) -> Disparity:
        """Return a copy without the pixels of ``mask``; those that had a value get ``reason``."""
        drop = np.flatnonzero(mask & self.valid)
        return Disparity(
            values=_put(self.values, drop, np.nan),
            confidence=_put(self.confidence, drop, 0.0),
            sigma_px=_put(self.sigma_px, drop, np.nan),
            reason=_put(self.reason, drop, int(reason)),
        )


@dataclass(frozen=True, eq=False, repr=False)
class RectifiedImage(Rectified):
    """A grey image, without lens distortion, that comes with its disparity: of a camera with depth.

    The other fields are those of the left view of a `RectifiedPair`. The disparity is that to a
    right view, a baseline of the camera beside it, of which there is no image.
    """

    left: UInt8
    disparity: Disparity
    camera: RectifiedCamera
    left_rgb: UInt8 | None = None
    valid: NDArray[np.bool_] | None = None
    timestamp_s: float = 0.0
    index: int = 0

    def __post_init__(self) -> None:
        _freeze_view(self, "left", "left_rgb")
        if self.disparity.values.shape != self.left.shape:
            got, expected = size_text(self.disparity.values), size_text(self.left)
            raise ShapeError("disparity and image differ in size", got=got, expected=expected)


Recorded = StereoPair | RectifiedImage
"""What a source delivers of a frame."""


def _put(array: NDArray[Any], places: NDArray[np.intp], value: ArrayLike) -> NDArray[Any]:
    changed: NDArray[Any] = array.copy()
    changed.flat[places] = value
    return changed
