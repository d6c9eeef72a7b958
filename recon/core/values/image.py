"""Stereo image pairs: as recorded, and rectified."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import ShapeError
from recon.core.values.arrays import UInt8, freeze, size_text
from recon.core.values.camera import RectifiedCamera


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Two images taken at the same time, as delivered by a source.

    Attributes:
        left: uint8 (H, W) grey or (H, W, 3) RGB.
        right: The same shape as ``left``.
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


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Two grey images with aligned rows.

    Slices of other images are copied: kernels would be compiled anew for their layout.

    Attributes:
        left: uint8 (H, W), grey.
        right: uint8 (H, W), grey.
        camera: Geometry of both views.
        left_rgb: uint8 (H, W, 3) colour of the left view, or None where the source is grey.
        right_rgb: The same of the right view.
        valid: bool (H, W), False where rectification had no source pixel; None = all valid.
        timestamp_s: Time of exposure.
        index: Number of the frame in its source.
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
        size = (self.camera.height_px, self.camera.width_px)
        for name in ("left", "right", "left_rgb", "right_rgb", "valid"):
            image = getattr(self, name)
            if isinstance(image, np.ndarray):
                object.__setattr__(self, name, np.ascontiguousarray(image))
        freeze(self, "left", np.uint8, size)
        freeze(self, "right", np.uint8, size)
        freeze(self, "left_rgb", np.uint8, (*size, 3))
        freeze(self, "right_rgb", np.uint8, (*size, 3))
        freeze(self, "valid", np.bool_, size)

    def __repr__(self) -> str:
        kind = "grey" if self.left_rgb is None else "colour"
        return f"RectifiedPair({kind}, frame {self.index}, {self.camera})"

    @property
    def colours(self) -> UInt8:
        """uint8 (H, W, 3): the left view in colour, or its grey values in all three channels."""
        if self.left_rgb is not None:
            return self.left_rgb
        return np.repeat(self.left[:, :, None], 3, axis=2)
