"""A learned matcher: a network that the user supplies as an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

import cv2
import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from recon.adapters.onnx import OnnxNetwork
from recon.errors import MatchingError, SettingsError
from recon.matching.unrated import UnratedSettings, unrated_disparity
from recon.structures import Disparity, Reason, RectifiedPair
from recon.structures.arrays import Float32, UInt8

_WHITE: Final = 255.0


class OnnxSettings(UnratedSettings):
    """Settings of the ONNX matcher: what the network expects, and what it gives."""

    model: Path | None = Field(default=None, description="The network, an .onnx file.")
    width_px: int | None = Field(
        default=None,
        ge=1,
        description="Width that the network takes; pictures are resized. None: any.",
    )
    height_px: int | None = Field(
        default=None,
        ge=1,
        description="Height that the network takes; with width_px or not at all.",
    )
    multiple_px: int = Field(
        default=32,
        ge=1,
        description="Where the size is free, pictures are widened at the right and the bottom to "
        "multiples of this.",
    )
    channels: Literal[1, 3] = Field(
        default=3, description="Channels of each picture; matching works on grey, so 3 are equal."
    )
    inputs: Literal["separate", "stacked"] = Field(
        default="separate",
        description="Left and right as two tensors (1, C, H, W), or as one (1, 2·C, H, W).",
    )
    mean: tuple[float, ...] = Field(
        default=(0.0,), description="Taken from grey levels in [0, 1]; one number, or per channel."
    )
    std: tuple[float, ...] = Field(
        default=(1.0,),
        description="Divides what is left; one number, or per channel. 1/255 makes "
        "levels in [0, 255].",
    )
    output: int = Field(default=-1, description="Which output is the disparity; -1 = the last.")
    output_scale: float = Field(
        default=1.0, description="Pixels per unit of the output; -1 where it is a flow to the left."
    )

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("width_px and height_px are given together or not at all")
        if any(len(numbers) not in {1, self.channels} for numbers in (self.mean, self.std)):
            raise ValueError("mean and std have one number, or one for each channel")
        if not all(number > 0 for number in self.std):
            raise ValueError("std must be above 0")
        return self


class OnnxMatcher:
    """Lets a network find the disparity; a `Matcher`. The network is loaded at the first pair.

    Args:
        settings: The network, and what it expects.
        threads: Threads that it may use; None = onnxruntime decides.
    """

    def __init__(self, settings: OnnxSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = threads
        self._network: OnnxNetwork | None = None

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            SettingsError: No network is given.
            MissingDependencyError: onnxruntime is not installed.
            FormatError: The network cannot be loaded.
            MatchingError: It does not fit the pictures, or gives no disparity map.
        """
        s = self._settings
        pictures = [_tensor(_fitted(image, s), s) for image in (pair.left, pair.right)]
        stacked = [np.concatenate(pictures, axis=1)] if s.inputs == "stacked" else pictures
        values = self._disparity_of(self._loaded().run(stacked))
        found = _unfitted(values, pair.left.shape, s)
        reason = np.where(np.isfinite(found), Reason.VALID, Reason.AMBIGUOUS).astype(np.uint8)
        return unrated_disparity(found, reason, pair, s)

    def _loaded(self) -> OnnxNetwork:
        if self._network is None:
            if self._settings.model is None:
                raise SettingsError(
                    "the matcher 'onnx' needs a network",
                    expected="a file",
                    hint="--set matching.onnx.model=network.onnx",
                )
            self._network = OnnxNetwork(self._settings.model, self._threads)
        return self._network

    def _disparity_of(self, outputs: list[Float32]) -> Float32:
        """float32 (h, w), pixels of what was put in, NaN = none."""
        number = self._settings.output
        if not -len(outputs) <= number < len(outputs):
            raise MatchingError("the network has no such output", got=number, expected=len(outputs))
        output = outputs[number]
        if output.ndim < 2 or output.size != output.shape[-1] * output.shape[-2]:
            raise MatchingError(
                "the network's output is not a disparity map",
                got=output.shape,
                expected="(1, 1, H, W) or with fewer ones",
            )
        values = output.reshape(output.shape[-2:]) * np.float32(self._settings.output_scale)
        return np.asarray(np.where(np.isfinite(values), values, np.nan), dtype=np.float32)


def _fitted(image: UInt8, s: OnnxSettings) -> UInt8:
    """The picture at the size that the network takes."""
    if s.width_px is not None and s.height_px is not None:
        shrinks = s.width_px < image.shape[1]
        way = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, (s.width_px, s.height_px), interpolation=way))
    below, beside = (-length % s.multiple_px for length in image.shape)
    return np.asarray(cv2.copyMakeBorder(image, 0, below, 0, beside, cv2.BORDER_REPLICATE))


def _unfitted(values: Float32, shape: tuple[int, ...], s: OnnxSettings) -> Float32:
    """The disparity at the size of the picture, in its pixels."""
    height, width = shape
    fixed = s.width_px is not None
    inner = (height, width) if fixed else tuple(n + -n % s.multiple_px for n in shape)
    if values.shape != inner:
        factor = np.float32(inner[1] / values.shape[1])
        resized = cv2.resize(values, inner[::-1], interpolation=cv2.INTER_LINEAR)
        values = np.asarray(resized * factor, dtype=np.float32)
    return values[:height, :width]


def _tensor(image: UInt8, s: OnnxSettings) -> Float32:
    """float32 (1, C, H, W), normalised."""
    mean, std = (
        np.array(numbers, dtype=np.float32).reshape(-1, 1, 1) for numbers in (s.mean, s.std)
    )
    levels = np.repeat(image[None].astype(np.float32) / np.float32(_WHITE), s.channels, axis=0)
    return np.asarray((levels - mean) / std, dtype=np.float32)[None]
