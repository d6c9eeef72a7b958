"""The fine matcher: learned features, paths, then a search among planes; for pairs that deserve it.

A network of some 100,000 weights describes each pixel by what is around it, in the image and at
half and a quarter of its size. How unlike two descriptions are is added to the costs of `sgm`, and
paths are followed as there. What they find is where a search among planes starts
(`kernels/planes.py`): where windows see nothing, planes go on from where they do, or are those of
whole segments. `scripts/train_features.py` makes the network, and says what it was trained on.
"""

from __future__ import annotations

import os
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.resources import files
from typing import Any, Final, TypeAlias

import cv2
import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, Int32, UInt8
from recon.stereo.kernels import convolution
from recon.stereo.kernels import planes as kernels
from recon.stereo.kernels.convolution import Blend, add_dissimilarity
from recon.stereo.kernels.path_costs import (
    Views,
    WriteCosts,
    empty_planes,
    padded,
    scaled_window,
    window_costs,
    write_views,
)
from recon.stereo.kernels.plane_minima import PARTS
from recon.stereo.kernels.semi_global import divided
from recon.stereo.match import search as common
from recon.stereo.match import sgm
from recon.stereo.match.fill import (
    SAME_SURFACE_PX,
    SEGMENTATIONS,
    fill_holes,
    fit_segments,
    outside,
    smooth_colours,
)

# Costs of one pixel, in units of those of `sgm`.
_LEARNED: Final = 14.0  # of features that are orthogonal; added to the costs of `sgm`
_LARGEST_LEARNED: Final = 17.0
_LARGEST: Final = _LARGEST_LEARNED + sgm.LARGEST_COST
_P1, _P2 = 16.0, 58.0  # penalties of paths from disparity to disparity
_PER_PX, _MOST = 50.0, 140.0  # and from plane to plane
_EDGE_RATIO: Final = 0.15  # of the latter that is left where the image has an edge
_RADIUS: Final = 1  # of windows; planes do what larger ones do
_LEVELS: Final = sgm.LEVELS / (_LARGEST + _P2)  # steps of a cost in a byte
_WINDOW: Final = scaled_window(
    radius=_RADIUS,
    rows_radius=_RADIUS,
    gradient_cap=sgm.COST_CAP,
    largest=sgm.LARGEST_COST,
    levels=_LEVELS,
)
_BLEND: Final = Blend(
    learned=_LEARNED * _LEVELS,
    largest=_LARGEST_LEARNED * _LEVELS,
    top=float(int(_LARGEST * _LEVELS)),
)
# Fitted on MiddEval3 at quarter and half size: of what planes and paths agree on, at least and by
# the square of the confidence of the paths.
_AGREED_CONFIDENCE: Final = (0.53, 0.46)
_VOLUME_BYTES: Final = 448 << 20  # at most; larger images are matched in strips of rows
_OVERLAP_ROWS: Final = 64  # of strips


class FineMatcher:
    """Matches for quality, in seconds per megapixel; a `Matcher`.

    A pixel is matched where paths and planes agree on it. ``threads`` (None = all cores) has no
    effect on the result.
    """

    def __init__(self, settings: common.SearchSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = max(1, threads or os.cpu_count() or 1)
        self._paths = sgm.PathSearch(self._threads)
        self._network: Any = None

    def match(self, pair: RectifiedPair) -> Disparity:
        height, width = pair.left.shape
        ndisp = self._settings.ndisp_within(pair.camera)
        rows = max(_VOLUME_BYTES // (padded(width) * ndisp), 4 * _OVERLAP_ROWS)
        if height <= rows:
            return self._match(pair, ndisp)
        parts = []
        for strip in divided(height, rows, _OVERLAP_ROWS):
            part = self._match(_rows(pair, strip.start, strip.end), ndisp)
            maps = part.values, part.confidence, part.sigma_px, part.reason
            parts.append(
                [one[strip.first - strip.start : strip.last - strip.start] for one in maps]
            )
        return Disparity(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _match(self, pair: RectifiedPair, ndisp: int) -> Disparity:
        s = self._settings
        paths = sgm.paths_of(ndisp, s.min_disparity_px, _P1, _P2, _LEVELS)
        rules = common.rules_of(s, ndisp, max(1, round(PARTS * _LEVELS)), odds=sgm.ODDS)
        volume = self._volume(pair, ndisp)
        seen = self._paths.run(pair, partial(_copy_costs, volume), 0, paths, rules)
        if not seen.valid.any():
            return seen
        changes = kernels.Changes(
            per_px=_PER_PX * _LEVELS,
            most=_MOST * _LEVELS,
            most_at_edge=_EDGE_RATIO * _MOST * _LEVELS,
            edge=sgm.EDGE_GREY_LEVELS,
            outside=float(sgm.LEVELS),
            minimum=s.min_disparity_px,
        )
        values = search_planes(pair, seen, volume, changes, self._threads)
        return _judged(pair, seen, values, (s.min_disparity_px, s.min_disparity_px + ndisp - 1))

    def _volume(self, pair: RectifiedPair, ndisp: int) -> UInt8:
        """Return the costs of all pixels, uint8 (H, P, at least W)."""
        minimum, (height, width) = self._settings.min_disparity_px, pair.left.shape
        views = Views(pair.left, *empty_planes(height, width, _RADIUS, ndisp))
        volume = np.empty((height, ndisp, padded(width)), np.uint8)
        if self._network is None:
            self._network = load_network()
        left, right = fine_grey(pair.left, pair.left_rgb), fine_grey(pair.right, pair.right_rgb)
        level = float(left.mean())
        describers = [Describer(self._network, image, level) for image in (left, right)]
        # As many rows as memory is meant for.
        at_once = max(_PIXELS // width // _STEP * _STEP, 2 * _REACH)

        def prepare(rows: range) -> None:
            write_views(pair.right, _RADIUS, minimum, rows, views)

        def compare(rows: range) -> None:
            write = window_costs(views, _WINDOW, volume.shape[2])
            write((0, width), rows.start, rows.stop, volume)

        with ThreadPoolExecutor(self._threads) as pool:
            for work in (prepare, compare):
                common.in_strips(pool, self._threads, work, height)
            for first in range(0, height, at_once):
                end = min(first + at_once, height)
                ours, others = (d.describe(first, end, pool, self._threads) for d in describers)
                given, to = (ours, others, width, minimum, _BLEND), volume[first:end]
                common.run_kernel(pool, self._threads, len(to), add_dissimilarity, given, to)
        return volume


def _copy_costs(volume: UInt8, _columns: int) -> WriteCosts:
    """Return what copies the costs of a volume (H, P, at least W)."""

    def write(band: tuple[int, int], top: int, bottom: int, costs: UInt8) -> None:
        start, end = band
        for y in range(top, bottom):
            costs[y % len(costs), :, : end - start] = volume[y, :, start:end]

    return write


def _rows(pair: RectifiedPair, start: int, end: int) -> RectifiedPair:
    names = ("left", "right", "left_rgb", "right_rgb", "valid")
    images = {name: getattr(pair, name) for name in names}
    rows: dict[str, Any] = {
        name: None if image is None else image[start:end] for name, image in images.items()
    }
    return replace(pair, camera=replace(pair.camera, height_px=end - start), **rows)


def _judged(
    pair: RectifiedPair, seen: Disparity, values: Float32, ends: tuple[int, int]
) -> Disparity:
    """Return the disparity with reasons, confidence and uncertainty.

    That a plane and what was seen agree makes both more probable than either. What planes alone
    lead to is not measured: it keeps the reason why nothing was found, or is AMBIGUOUS where a
    plane contradicts what was, BORDER or OUT_OF_RANGE where it leads there.
    """
    with np.errstate(invalid="ignore"):
        agree = seen.valid & (np.abs(values - seen.values) <= SAME_SURFACE_PX)
    beyond, border = (values < ends[0]) | (values > ends[1]), outside(values)
    if pair.valid is not None:
        border |= ~pair.valid
    agree &= ~(beyond | border)
    reason = np.where(seen.valid & ~agree, np.uint8(Reason.AMBIGUOUS), seen.reason)
    reason[beyond], reason[border] = np.uint8(Reason.OUT_OF_RANGE), np.uint8(Reason.BORDER)
    least, more = _AGREED_CONFIDENCE
    sure, nan = np.float32(least) + np.float32(more) * seen.confidence**2, np.float32(np.nan)
    return Disparity(
        values=np.where(agree, values, nan),
        confidence=np.where(agree, sure, np.float32(0)),
        sigma_px=np.where(agree, seen.sigma_px, nan),
        reason=reason,
    )


# Distances that planes come from in each round, near ones in six directions, far ones in three.
_ROUNDS: Final = ((4, 24), (12, 70))
_NEAR_FIT_PX, _FAR_FIT_PX, _LAST_FIT_PX = 12, 30, 5  # half the square that a plane is fitted to
_SAMPLES: Final = 5  # pixels of a fit, from its middle to its side, at least
_COLOUR: Final = 30.0  # difference, over three channels, at which a weight falls to 1/e
NOW, FIRST, FITTED, SEGMENTS = range(4)
"""Whose planes a pixel may take: those chosen last, seen at first, or fitted to either; from there
on those of the segments that it is in."""


def search_planes(
    pair: RectifiedPair, seen: Disparity, volume: UInt8, changes: kernels.Changes, threads: int
) -> Float32:
    """Return the disparity of the plane that each pixel takes, float32 (H, W), without NaN.

    ``volume`` is the cost of each candidate, uint8 (H, P, at least W); ``seen`` was found in it.
    """
    size = pair.left.shape
    filled = fill_holes(seen.values)
    sources = np.zeros((SEGMENTS + SEGMENTATIONS, 3, *size), np.float32)
    sources[:, 0] = np.where(np.isfinite(filled), filled, np.float32(changes.minimum))
    everywhere = np.ones(size, np.float32)
    with ThreadPoolExecutor(threads) as pool:
        fits = _Fits(pair, pool, threads)
        fits.fit(seen.values, seen.confidence, _NEAR_FIT_PX, sources[FIRST], own=True)
        fits.fit(seen.values, seen.confidence, _FAR_FIT_PX, sources[FITTED])
        sources[SEGMENTS:] = sources[FITTED]
        fit_segments(fits.guide, seen, sources[SEGMENTS:], pool, threads)
        sources[NOW] = sources[FIRST]
        for number, (near, far) in enumerate(_ROUNDS):
            table = _table(near, far, number)
            sums = np.empty((2, *size, len(table)), np.float32)
            sweeps = [
                pool.submit(
                    kernels.sweep,
                    *(sources, table, volume, pair.left, changes, upwards, sums[int(upwards)]),
                )
                for upwards in (False, True)
            ]
            for done in sweeps:
                done.result()
            chosen = np.empty((3, *size), np.float32)
            given, choose = (*sums, sources, table), kernels.choose_planes
            common.run_kernel(pool, threads, size[0], choose, given, chosen)
            sources[NOW] = sources[FITTED] = chosen
            last = number + 1 == len(_ROUNDS)
            radius = _LAST_FIT_PX if last else _NEAR_FIT_PX
            fits.fit(chosen[0], everywhere, radius, sources[FITTED])
    # Planes of neighbours on one surface differ by parts of a pixel.
    chosen, fitted = sources[NOW, 0], sources[FITTED, 0]
    near_by = np.abs(fitted - chosen) < SAME_SURFACE_PX / 2
    return np.asarray(np.where(near_by, fitted, chosen), dtype=np.float32)


class _Fits:
    """Fits planes to disparities, of pixels of like colour."""

    def __init__(self, pair: RectifiedPair, pool: Executor, threads: int) -> None:
        self.guide = smooth_colours(pair)
        self._alike = np.exp(np.arange(766) / -_COLOUR).astype(np.float32)
        self._pool, self._threads = pool, threads

    def fit(
        self, values: Float32, weights: Float32, radius: int, to: Float32, *, own: bool = False
    ) -> None:
        """Write the planes of all pixels, (3, H, W); ``own``: with the values that they have."""
        nodes = np.empty((3, *(-(-n // kernels.NODE_PX) for n in values.shape)), np.float32)
        stride = max(1, radius // _SAMPLES)
        on, fitted = (self._pool, self._threads), (nodes, values, own)
        given = values, weights, self.guide, self._alike, radius, stride, SAME_SURFACE_PX
        common.run_kernel(*on, nodes.shape[1], kernels.fit_nodes, given, nodes)
        common.run_kernel(*on, len(values), kernels.spread_nodes, fitted, to)


def _table(near: int, far: int, number: int) -> Int32:
    """Return which planes a pixel may take in a round, int32 (K, 3): source, columns and rows."""
    around = []
    for count, reach, turn in ((6, near, 0.3 * number), (3, far, 0.2 + 0.4 * number)):
        angles = turn + 2 * np.pi * np.arange(count) / count
        ends = np.rint(reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(int)
        around += [(NOW, *end) for end in ends]
    here = [(source, 0, 0) for source in (NOW, FIRST, FITTED)]
    planes = [(SEGMENTS + number, 0, 0) for number in range(SEGMENTATIONS)]
    return np.array([*here, *around, *planes], np.int32)


_PIXELS: Final = 1 << 19  # described at a time: 130 MB
_SIZES: Final = 1, 2, 4  # divisors
_STEP: Final = _SIZES[-1]
_REACH: Final = 24  # pixels around one that its description depends on, a multiple of `_STEP`
_LAYERS: Final = 5  # of each size, over 3 by 3 pixels
_SCALE: Final = 32.0  # grey levels of one unit
_SLOPE: Final = 0.1  # of a layer, below zero
_WEIGHTS: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # of red, green and blue
# Steps of 16 bits: of a grey level, of a unit between layers (where no image exceeds 45 of them),
# and of a unit of features.
_GREY, _BETWEEN, _LAST = 64.0, 512.0, 1024.0
_LARGEST_SUM: Final = 65_000  # of the sizes of weights: with any features a sum fits into 32 bits


Network: TypeAlias = list[tuple[convolution.Layer, ...]]
"""The layers of each size; the last one gives its part of the features."""


class Describer:
    """Describes the pixels of one image; rows may be asked for in any order."""

    def __init__(self, network: Network, image: Float32, level: float) -> None:
        self._network = network
        below, beside = (_REACH + -length % _STEP for length in image.shape)
        whole = cv2.copyMakeBorder(
            (image - np.float32(level)) * np.float32(_GREY),
            *(_REACH, below, _REACH, beside),
            cv2.BORDER_REPLICATE,
        )
        self._images = []
        for size in _SIZES:
            # The square of all layers for the first pixel, or the one before it if it is enlarged.
            start, smaller = _REACH // size - _LAYERS - (size > 1), {"fx": 1 / size, "fy": 1 / size}
            grey = cv2.resize(whole, None, **smaller, interpolation=cv2.INTER_AREA)[start:, start:]
            beyond = convolution.STEP + -grey.shape[1] % convolution.STEP
            grey = cv2.copyMakeBorder(grey, 0, 0, 0, beyond, cv2.BORDER_REPLICATE)
            self._images.append((np.rint(grey).astype(np.int32) & 0xFFFF)[:, None])

    def describe(self, first: int, end: int, pool: Executor, threads: int) -> Int32:
        """Return features of length `UNIT` of rows ``first`` (a multiple of 4) to ``end - 1``.

        int32 (N, C / 2, at least W), each two of int16. What is around them is read as well, so
        they are the same in any pieces.
        """
        bottom, found = end + -end % _STEP, []
        for image, layers, size in zip(self._images, self._network, _SIZES, strict=True):
            rows = (bottom - first) // size + 2 * (size > 1)
            part = image[first // size : first // size + rows + 2 * _LAYERS]
            to = np.empty((rows, layers[-1].bias.size // 2, image.shape[2]), np.int32)
            convolve = convolution.convolve_rows
            common.run_kernel(pool, threads, rows, convolve, (part, layers), to)
            found.append(to)
        common.run_kernel(pool, threads, end - first, convolution.unite, found)
        return found[0][: end - first]  # those of full size


def load_network() -> Network:
    """Load the network that comes with the program."""
    with files("recon.stereo.match").joinpath("features.npz").open("rb") as file:
        weights = dict(np.load(file))
    sizes: Network = []
    parts = np.split(weights["f.weight"], len(_SIZES), axis=1)
    for number, (name, size, part) in enumerate(zip("abd", _SIZES, parts, strict=True)):
        layers, steps = [], _GREY * _SCALE / size
        for n in range(_LAYERS):
            kernel, bias = weights[f"{name}.{n}.weight"], weights[f"{name}.{n}.bias"]
            layers.append(_layer(kernel, bias, steps, _BETWEEN, _SLOPE))
            steps = _BETWEEN
        bias = weights["f.bias"] if number == 0 else np.zeros_like(weights["f.bias"])
        sizes.append((*layers, _layer(part, bias, steps, _LAST, 1.0)))
    return sizes


def _layer(
    weights: Float32, bias: Float32, steps: float, steps_after: float, slope: float
) -> convolution.Layer:
    """Return a layer in 16 bits, from weights (O, C, S, S) and the steps of a unit around it."""
    (out, channels), group = weights.shape[:2], convolution.GROUP
    flat = weights.reshape(out, channels, -1)
    if channels % 2:
        flat = np.concatenate([flat, np.zeros_like(flat)], axis=1)
    fine = _LARGEST_SUM / np.abs(flat).sum(axis=(1, 2))
    fine = np.minimum(fine, 32767 / np.abs(flat).max(axis=(1, 2)))
    whole = np.rint(flat * fine[:, None, None]).astype(np.int16)
    groups = whole.reshape(-1, group, flat.shape[1] // 2, 2, flat.shape[2])
    pairs = np.ascontiguousarray(groups.transpose(0, 2, 4, 1, 3)).view(np.int32)
    scale = steps_after / (fine * steps)
    return convolution.Layer(
        weights=pairs.reshape(len(pairs), -1, group),
        scale=scale.astype(np.float32),
        bias=(bias * steps_after).astype(np.float32),
        slope=slope,
    )


def fine_grey(grey: UInt8, rgb: UInt8 | None) -> Float32:
    """Return grey levels (H, W), with those between whole ones where there is colour."""
    if rgb is None:
        return grey.astype(np.float32)
    return np.asarray(rgb @ _WEIGHTS, dtype=np.float32)
