"""A learned matcher: a network that the user supplies as an ONNX file."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import cv2
import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.errors import MatchingError, SettingsError
from recon.core.settings import Settings
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, UInt8
from recon.stereo.match.agreement import rate_by_agreement
from recon.stereo.match.network import LARGEST_PX, OnnxNetwork
from recon.stereo.match.presets import OWN, PRESETS, Preset
from recon.stereo.match.protocol import unrated_disparity
from recon.stereo.match.search import LEFT_RIGHT_PX, usual_ndisp
from recon.stereo.match.self_test import check_network
from recon.stereo.match.tiles import match_in_tiles

_WHITE: Final = 255.0
# Larger images are matched in tiles of so many pixels, where the network takes any size: a small
# network needs 1 to 2 GB for them.
_TILE_PX: Final = 1_000_000
_TIME_LIMIT_S: Final = 600.0  # of an image or tile: one that never ends is refused
Size = tuple[int, int]  # width and height
_Length = Annotated[int, Field(ge=1, le=LARGEST_PX)]


class OnnxSettings(Settings):
    """Settings of the ONNX matcher: what the network expects, and what it gives.

    The number of inputs and their channels are read from the network; two images of three channels
    are in colour where the pair is.
    """

    model: Path | None = None
    """The network, an .onnx file."""
    preset: Literal["hitnet", "lite-any-stereo"] | None = None
    """Which published network it is: sets mean, std, output and output_scale, unless they are set,
    and names licence and training sets in the results."""
    size_px: tuple[_Length, _Length] | None = None
    """Width and height at which the network matches; images are resized. none = its own, or that of
    the images, widened to a multiple of 32. Smaller is faster."""
    mean: tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...] | None = None
    """Taken from levels in [0, 1]; one number, or per channel (red, green, blue). none = 0, or as
    the preset says."""
    std: tuple[Annotated[float, Field(ge=1e-6, le=1e6)], ...] | None = None
    """Divides what is left; one number, or per channel. 1/255 makes levels in [0, 255]. none = 1,
    or as the preset says."""
    output: int | None = Field(None, ge=-1000, le=1000)
    """Which output is the disparity; -1 = the last. none = that, or as the preset says."""
    output_scale: float | None = Field(None, ge=-1000000.0, le=1000000.0)
    """Pixels per unit of the output; -1 where it is a flow to the left. none = 1, or as the preset
    says."""
    left_right: bool = True
    """Match the right view too, in twice the time: what both views agree on is kept, and how well
    they agree makes confidence and sigma_px. Else all matches have the same."""
    self_test: bool = True
    """Let the network match a rendered plane first, and refuse it if it does not find the
    disparity."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if any(one is not None and len(one) not in {1, 3} for one in (self.mean, self.std)):
            raise ValueError("mean and std have one number, or one for each of three channels")
        return self

    def read(self) -> Preset:
        """Return how the network is fed and read: what is set, else what the preset says."""
        names = ("mean", "std", "output", "output_scale")
        own = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(PRESETS[self.preset] if self.preset else OWN, **own)


def describe_network(settings: OnnxSettings) -> dict[str, Any]:
    """Return what a result says of its network, ready for JSON: file, checksum, licence, sets."""
    if settings.model is None or not settings.model.is_file():
        return {}
    use = settings.read()
    return {
        "file": settings.model.name,
        "sha256": hashlib.sha256(settings.model.read_bytes()).hexdigest(),
        "preset": settings.preset,
        "licence": use.licence,
        "trained_on": use.trained_on,
    }


class OnnxMatcher:
    """Lets a network find the disparity; a `Matcher`. The network is loaded at the first pair."""

    def __init__(self, settings: OnnxSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._use = settings.read()
        self._threads = threads
        self._network: OnnxNetwork | None = None

    def match(self, pair: RectifiedPair) -> Disparity:
        network = self._loaded()
        left, right = pair.left, pair.right
        if network.channels == 3 and pair.left_rgb is not None and pair.right_rgb is not None:
            left, right = pair.left_rgb, pair.right_rgb
        reach_px = pair.camera.ndisp or usual_ndisp(pair.camera.width_px)
        found = self._disparity(network, left, right, reach_px)
        if not self._settings.left_right:
            there = np.isfinite(found)
            reason = np.where(there, Reason.VALID, Reason.AMBIGUOUS).astype(np.uint8)
            return unrated_disparity(found, reason, pair)
        # Seen in a mirror, the right view is the left one of a pair.
        of_right = self._disparity(network, right[:, ::-1], left[:, ::-1], reach_px)[:, ::-1]
        size = self._settings.size_px or network.size
        limit = LEFT_RIGHT_PX * max(1.0, left.shape[1] / size[0] if size else 1.0)
        return rate_by_agreement(found, of_right, pair, limit)

    def _loaded(self) -> OnnxNetwork:
        if self._network is None:
            path, s = self._settings.model, self._settings
            if path is None:
                get = f": {self._use.get}" if self._use.get else ""
                what, hint = "the matcher 'onnx' needs a network", "--set matching.onnx.model=FILE"
                raise SettingsError(what, expected=f"a file{get}", hint=hint)
            network = OnnxNetwork(path, self._threads, _TIME_LIMIT_S)
            if self._use.layout not in {"", network.layout}:
                what, hint = f"not the network of the preset {s.preset!r}", f"get {self._use.get}"
                how = {"got": network.layout, "expected": self._use.layout, "hint": hint}
                raise SettingsError(what, where=path, **how)
            if s.self_test:

                def match(left: UInt8, right: UInt8) -> Float32:
                    return self._disparity(network, left, right, left.shape[1])

                check_network(match, s.size_px or network.size, self._use.output_scale, path)
            self._network = network
        return self._network

    def _disparity(self, network: OnnxNetwork, left: UInt8, right: UInt8, reach_px: int) -> Float32:
        """Return float32 (H, W) of the left of two views, pixels, NaN = none."""
        size = self._settings.size_px or network.size
        (height, width), multiple = left.shape[:2], self._use.multiple_px
        views = _fitted(left, size, multiple), _fitted(right, size, multiple)

        def match(*views: UInt8) -> Float32:
            return self._run(network, views)

        most = _TILE_PX if size is None else views[0].size
        values = match_in_tiles(match, views, reach_px, most, multiple)
        return values[:height, :width] if size is None else _resized(values, (height, width))

    def _run(self, network: OnnxNetwork, views: tuple[UInt8, ...]) -> Float32:
        inputs = [_tensor(view, network.channels, self._use) for view in views]
        if network.stacked:
            inputs = [np.concatenate(inputs, axis=1)]
        return _resized(self._disparity_of(network.run(inputs)), views[0].shape[:2])

    def _disparity_of(self, outputs: list[Float32]) -> Float32:
        """Return float32 (h, w), pixels of what was put in, NaN = none."""
        number = self._use.output
        if not -len(outputs) <= number < len(outputs):
            raise MatchingError("the network has no such output", got=number, expected=len(outputs))
        output = outputs[number]
        values = output.squeeze()
        if values.ndim != 2 or not values.size:
            what = "the network's output is not a disparity map"
            expected = "(1, 1, H, W), (1, H, W, 1) or with fewer ones"
            raise MatchingError(what, got=output.shape, expected=expected)
        values = values * np.float32(self._use.output_scale)
        return np.asarray(np.where(np.isfinite(values), values, np.nan), dtype=np.float32)


def _fitted(image: UInt8, size: Size | None, multiple_px: int) -> UInt8:
    if size is not None:
        way = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, size, interpolation=way))
    below, beside = (-length % multiple_px for length in image.shape[:2])
    return np.asarray(cv2.copyMakeBorder(image, 0, below, 0, beside, cv2.BORDER_REPLICATE))


def _resized(values: Float32, shape: tuple[int, ...]) -> Float32:
    """Return a disparity at another size, in pixels of that size."""
    if values.shape == shape:
        return values
    factor = np.float32(shape[1] / values.shape[1])
    resized = cv2.resize(values, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(resized * factor, dtype=np.float32)


def _tensor(image: UInt8, channels: int, use: Preset) -> Float32:
    """Return one image as (1, C, H, W)."""
    if max(len(use.mean), len(use.std)) > channels:
        what = "mean and std have more numbers than the network has channels"
        got = max(len(use.mean), len(use.std))
        raise SettingsError(what, got=got, expected=f"1 or {channels}")
    mean, std = (
        np.array(numbers, dtype=np.float32).reshape(-1, 1, 1) for numbers in (use.mean, use.std)
    )
    levels = image.astype(np.float32) / np.float32(_WHITE)
    planes = levels.transpose(2, 0, 1) if image.ndim == 3 else levels[None].repeat(channels, axis=0)
    return np.asarray((planes - mean) / std, dtype=np.float32)[None]
