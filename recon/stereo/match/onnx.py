"""A learned matcher: a network that the user supplies as an ONNX file.

Of networks that others publish it is said what to get, its licence, and how it is fed: only what
their authors or the file itself state. No checksum is known of an ONNX file of theirs: the one of
the file that was given is recorded with each result.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal

import cv2
import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.errors import MatchingError, SettingsError
from recon.core.settings import Settings
from recon.core.summary import Figures
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Bool, Float32, UInt8
from recon.core.values.image import ASSUMED_SIGMA_PX
from recon.stereo.match.network import LARGEST_PX, OnnxNetwork, check_network, match_in_tiles
from recon.stereo.match.protocol import unrated_disparity
from recon.stereo.match.search import LEFT_RIGHT_PX, usual_ndisp

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


@dataclass(frozen=True)
class NetworkFigures(Figures):
    """What a result says of its network."""

    file: str
    sha256: str
    preset: str | None
    licence: str
    trained_on: str


def describe_network(settings: OnnxSettings) -> NetworkFigures | None:
    """Return what a result says of its network; None = there is no such file."""
    if settings.model is None or not settings.model.is_file():
        return None
    use, name = settings.read(), settings.model.name
    digest = hashlib.sha256(settings.model.read_bytes()).hexdigest()
    return NetworkFigures(name, digest, settings.preset, use.licence, use.trained_on)


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
            inputs = [_tensor(view, network.channels, self._use) for view in views]
            if network.stacked:
                inputs = [np.concatenate(inputs, axis=1)]
            return _resized(self._disparity_of(network.run(inputs)), views[0].shape[:2])

        most = _TILE_PX if size is None else views[0].size
        values = match_in_tiles(match, views, reach_px, most, multiple)
        return values[:height, :width] if size is None else _resized(values, (height, width))

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


@dataclass(frozen=True)
class Preset:
    """One published network; the settings of `OnnxSettings` that are not set are its."""

    get: str  # which file, and where
    licence: str  # and where it is stated
    trained_on: str
    layout: str = "2 inputs of 3 channels"  # `OnnxNetwork.layout`
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    output: int = -1
    output_scale: float = 1.0
    multiple_px: int = 32


#: Of a network that no preset describes.
OWN: Final = Preset("", "not known", "not known", layout="")

PRESETS: Final = {
    # Ref: Tankovich et al., "HITNet: Hierarchical iterative tile refinement network for real-time
    # stereo matching", CVPR 2021. Grey levels in [0, 1], both images in one input.
    "hitnet": Preset(
        get="hitnet_eth3d_480x640.onnx of github.com/nburrus/stereodemo, release v0.1-hitnet",
        licence="Apache-2.0 (that of the sources in google-research; none is stated for weights)",
        trained_on="ETH3D, by its name; its authors do not state what else",
        layout="1 input of 2 channels",
    ),
    # Ref: Jing et al., "Lite Any Stereo: Efficient zero-shot stereo matching", CVPR 2026. Levels in
    # [0, 255], which it normalises itself.
    "lite-any-stereo": Preset(
        get="LiteAnyStereo.pth of github.com/TomTomTommi/LiteAnyStereo, exported with its "
        "export_onnx.py --version las1",
        licence="MIT (LICENSE of github.com/TomTomTommi/LiteAnyStereo)",
        trained_on="synthetic sets and pairs without truth, named in arXiv:2511.16555; not those "
        "of Middlebury, ETH3D and KITTI, by its authors",
        std=(1 / 255,),
    ),
}


_WINDOW_PX: Final = 7  # in which the disagreement of both views is averaged
#: Odds of a match to be right to a pixel, at a disagreement of one pixel, and how they fall with
#: it: fitted on seven scenes of MiddEval3 with the features of `fine`, a cost volume of their
#: products and a soft minimum. Networks that are wrong in the same way in both views are surer.
_ODDS, _POWER = 0.9, 1.6
_LEAST_PX: Final = 0.05  # a smaller disagreement says no more


def rate_by_agreement(
    values: Float32, of_right: Float32, pair: RectifiedPair, limit_px: float
) -> Disparity:
    """Return a disparity map whose confidence and sigma follow from how well both views agree.

    Args:
        values: float32 (H, W), disparity of the left view, px; NaN = none.
        of_right: float32 (H, W), that of the right view, ``x_left - x_right`` of its pixels too.
        pair: The images.
        limit_px: Matches that differ by more are removed: as OCCLUDED where no pixel of the right
            view is matched with them, else as LEFT_RIGHT.
    """
    rows, columns = np.mgrid[: values.shape[0], : values.shape[1]].astype(np.float32)
    there = np.where(np.isfinite(values), columns - values, np.float32(-2))
    sampled = cv2.remap(
        of_right, there, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )
    apart = np.abs(values - np.asarray(sampled, dtype=np.float32))
    agree = apart <= limit_px  # not where either is NaN
    reason = np.where(_seen(of_right), np.uint8(Reason.LEFT_RIGHT), np.uint8(Reason.OCCLUDED))
    reason[agree] = Reason.VALID
    reason[~np.isfinite(values)] = Reason.AMBIGUOUS
    found = unrated_disparity(values, reason, pair)
    capped = np.where(agree, apart, np.float32(limit_px))
    mean_square = cv2.blur(capped * capped, (_WINDOW_PX, _WINDOW_PX))
    odds = _ODDS * np.maximum(np.sqrt(mean_square), _LEAST_PX) ** -_POWER
    sure = np.asarray(odds / (1 + odds), dtype=np.float32)
    # The difference of two estimates has twice the variance of each.
    sigma = np.sqrt(ASSUMED_SIGMA_PX**2 + mean_square / 2)
    both = np.sqrt(sure * sigma**2 + (1 - sure) * np.maximum(sigma, 1) ** 2)
    return replace(
        found,
        confidence=np.where(found.valid, sure, 0).astype(np.float32),
        sigma_px=np.where(found.valid, both, np.nan).astype(np.float32),
    )


def _seen(of_right: Float32) -> Bool:
    """Return which pixels of the left view some pixel of the right view is matched with."""
    height, width = of_right.shape
    to = np.where(np.isfinite(of_right), np.arange(width) + of_right, -1)
    to = np.rint(np.clip(to, -1, width)).astype(np.intp) + 1
    seen = np.zeros((height, width + 2), dtype=np.bool_)
    seen[np.arange(height)[:, None], to] = True
    return seen[:, 1:-1]
