"""A learned matcher: a network that the user supplies as an ONNX file, run by onnxruntime."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import cv2
import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.errors import FormatError, MatchingError, SettingsError, require
from recon.core.settings import Settings
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, UInt8
from recon.stereo.match.protocol import unrated_disparity

_WHITE: Final = 255.0
_MULTIPLE_PX: Final = 32  # of free sizes, as networks with five halvings of the size need


class OnnxSettings(Settings):
    """Settings of the ONNX matcher: what the network expects, and what it gives.

    The number of inputs and their channels are read from the network.
    """

    model: Path | None = None
    """The network, an .onnx file."""
    width_px: int | None = Field(None, ge=1, le=10000)
    """Width at which the network matches; images are resized. none = its own, or that of the
    images, widened to a multiple of 32. Smaller is faster."""
    height_px: int | None = Field(None, ge=1, le=10000)
    """Height at which it matches; with width_px or not at all."""
    mean: tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...] = Field((0.0,))
    """Taken from grey levels in [0, 1]; one number, or per channel."""
    std: tuple[Annotated[float, Field(ge=1e-6, le=1e6)], ...] = Field((1.0,))
    """Divides what is left; one number, or per channel. 1/255 makes levels in [0, 255]."""
    output: int = Field(-1, ge=-1000, le=1000)
    """Which output is the disparity; -1 = the last."""
    output_scale: float = Field(1.0, ge=-1000000.0, le=1000000.0)
    """Pixels per unit of the output; -1 where it is a flow to the left."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("width_px and height_px are given together or not at all")
        if any(len(numbers) not in {1, 3} for numbers in (self.mean, self.std)):
            raise ValueError("mean and std have one number, or one for each of three channels")
        return self


class OnnxMatcher:
    """Lets a network find the disparity; a `Matcher`. The network is loaded at the first pair."""

    def __init__(self, settings: OnnxSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = threads
        self._network: OnnxNetwork | None = None

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair."""
        s, network = self._settings, self._loaded()
        declared = network.input_shapes
        # One input takes both images, one behind the other: (1, 2·C, H, W).
        stacked = len(declared) == 1
        channels, size = _channels(declared[0], stacked), _size(declared[0], s)
        images = [_tensor(_fitted(image, size), channels, s) for image in (pair.left, pair.right)]
        inputs = [np.concatenate(images, axis=1)] if stacked else images
        values = self._disparity_of(network.run(inputs))
        found = _unfitted(values, pair.left.shape, size)
        reason = np.where(np.isfinite(found), Reason.VALID, Reason.AMBIGUOUS).astype(np.uint8)
        return unrated_disparity(found, reason, pair)

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
        """Return float32 (h, w), pixels of what was put in, NaN = none."""
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


def _channels(declared: tuple[int | None, ...], stacked: bool) -> int:
    """Return the channels of one image by the shape of an input; where that leaves them free, 3."""
    channels = declared[1] if len(declared) == 4 else None
    if channels is None:
        return 3
    return max(1, channels // 2) if stacked else channels


def _size(declared: tuple[int | None, ...], s: OnnxSettings) -> tuple[int, int] | None:
    """Return the width and height that images are resized to; None = they keep theirs."""
    if s.width_px is not None and s.height_px is not None:
        return s.width_px, s.height_px
    height, width = declared[2:] if len(declared) == 4 else (None, None)
    return None if width is None or height is None else (width, height)


def _fitted(image: UInt8, size: tuple[int, int] | None) -> UInt8:
    if size is not None:
        way = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, size, interpolation=way))
    below, beside = (-length % _MULTIPLE_PX for length in image.shape)
    return np.asarray(cv2.copyMakeBorder(image, 0, below, 0, beside, cv2.BORDER_REPLICATE))


def _unfitted(values: Float32, shape: tuple[int, ...], size: tuple[int, int] | None) -> Float32:
    height, width = shape
    inner = (height, width) if size else tuple(n + -n % _MULTIPLE_PX for n in shape)
    if values.shape != inner:
        factor = np.float32(inner[1] / values.shape[1])
        resized = cv2.resize(values, inner[::-1], interpolation=cv2.INTER_LINEAR)
        values = np.asarray(resized * factor, dtype=np.float32)
    return values[:height, :width]


def _tensor(image: UInt8, channels: int, s: OnnxSettings) -> Float32:
    if max(len(s.mean), len(s.std)) > channels:
        raise SettingsError(
            "mean and std have more numbers than the network has channels",
            got=max(len(s.mean), len(s.std)),
            expected=f"1 or {channels}",
        )
    mean, std = (
        np.array(numbers, dtype=np.float32).reshape(-1, 1, 1) for numbers in (s.mean, s.std)
    )
    levels = np.repeat(image[None].astype(np.float32) / np.float32(_WHITE), channels, axis=0)
    return np.asarray((levels - mean) / std, dtype=np.float32)[None]


class OnnxNetwork:
    """A loaded network, run on the CPU; ``threads`` per operator, None = onnxruntime's default."""

    def __init__(self, path: Path, threads: int | None = None) -> None:
        runtime = require("onnxruntime", extra="onnx")
        if not path.is_file():
            raise FormatError("file does not exist", where=path, expected="an ONNX network")
        self._path = path
        self._errors = _errors_of(runtime)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.log_severity_level = 4  # fatal only: lesser errors arrive as exceptions
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except self._errors as error:
            raise FormatError(
                "onnxruntime cannot load the network", where=path, got=_first_line(error)
            ) from error

    @property
    def input_shapes(self) -> tuple[tuple[int | None, ...], ...]:
        """The shape of each input as the network declares it; None = a size that is free."""
        return tuple(
            tuple(length if isinstance(length, int) else None for length in one.shape)
            for one in self._session.get_inputs()
        )

    def run(self, inputs: Sequence[Float32]) -> list[Float32]:
        """Run the network once, from float32 arrays in the order of its inputs."""
        wanted = self._session.get_inputs()
        if len(wanted) != len(inputs):
            raise MatchingError(
                "the network has a different number of inputs",
                where=self._path,
                got=f"{len(wanted)}: {', '.join(one.name for one in wanted)}",
                expected=str(len(inputs)),
            )
        feed = {one.name: np.ascontiguousarray(x) for one, x in zip(wanted, inputs, strict=True)}
        try:
            outputs = self._session.run(None, feed)
        except self._errors as error:
            raise MatchingError(
                "the network cannot process these images",
                where=self._path,
                got=_first_line(error),
                hint="check the size that it expects: matching.onnx.width_px and height_px",
            ) from error
        return [np.asarray(output, dtype=np.float32) for output in outputs]


def _errors_of(runtime: Any) -> tuple[type[Exception], ...]:
    """Return exceptions that onnxruntime raises: its own have no common base class."""
    state = vars(runtime.capi.onnxruntime_pybind11_state).values()
    own = [kind for kind in state if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, ValueError, TypeError)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
