"""The network in 16 bits beside plain convolutions, and the products of its features."""

from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files

import cv2
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view

from recon.stereo.kernels import convolution as kernels
from recon.stereo.kernels.convolution import TILE, Blend, add_dissimilarity
from recon.stereo.kernels.simd.vectors import SUMS
from recon.stereo.match.fine import Describer, load_network


def pairs_of(values: np.ndarray) -> np.ndarray:
    """Channels (N, C, W) of int16 as pairs of them, int32 (N, C / 2, W)."""
    n, channels, width = values.shape
    apart = values.astype(np.int16).reshape(n, channels // 2, 2, width).transpose(0, 1, 3, 2)
    return np.ascontiguousarray(apart).view(np.int32)[..., 0]


def channels_of(pairs: np.ndarray) -> np.ndarray:
    n, half, width = pairs.shape
    apart = np.ascontiguousarray(pairs).view(np.int16).reshape(n, half, width, 2)
    return apart.transpose(0, 1, 3, 2).reshape(n, 2 * half, width)


def layer_of(weights: np.ndarray, scale: float, bias: np.ndarray, slope: float) -> kernels.Layer:
    out, channels = weights.shape[:2]
    groups = weights.astype(np.int16).reshape(out // SUMS, SUMS, channels // 2, 2, -1)
    pairs = np.ascontiguousarray(groups.transpose(0, 2, 4, 1, 3)).view(np.int32)
    flat = pairs.reshape(out // SUMS, -1, SUMS)
    return kernels.Layer(flat, np.full(out, scale, np.float32), bias.astype(np.float32), slope)


def convolve_reference(image, weights, scale, bias, slope):
    """A convolution of rows (H, C, W) by weights (O, C, S, S), where they lie within."""
    side = weights.shape[2]
    around = sliding_window_view(image.astype(np.float64), (side, side), axis=(0, 2))
    sums = np.einsum("hcwij,ocij->how", around, weights.astype(np.float64))
    value = (sums * np.float32(scale)) + bias.astype(np.float32)[:, None]
    return np.rint(np.clip(np.where(value > 0, value, slope * value), -32767, 32767))


@settings(max_examples=20 if numba.config.DISABLE_JIT else 100)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 70), st.integers(1, 3))
def test_layers_equal_plain_convolutions(seed, height, width, count):
    rng = np.random.default_rng(seed)
    rows, columns = height + 2 * count, width + 2 * count
    # What is computed beyond is not read: any columns may follow.
    image = rng.integers(-400, 400, (rows, 2, columns + kernels.STEP + -columns % kernels.STEP))
    image[:, 1] = 0
    expected, layers, channels = image, [], 2
    for n in range(count + 1):
        side = 1 if n == count else kernels.SIDE
        out = SUMS if n == count else 2 * SUMS
        weights = rng.integers(-60, 60, (out, channels, side, side))
        bias, slope = rng.normal(0, 40, out), 1.0 if n == count else 0.1
        layers.append(layer_of(weights, 0.01, bias, slope))
        expected, channels = convolve_reference(expected, weights, 0.01, bias, slope), out
    found = np.full((height, SUMS // 2, image.shape[2]), 7, np.int32)
    middle = height // 2
    for first, end in ((0, middle), (middle, height)):
        kernels.convolve_rows(pairs_of(image), tuple(layers), first, end, found)
    apart = np.abs(channels_of(found)[:, :, :width] - expected[:, :, :width])
    # Halves may be rounded either way, and a layer passes that on.
    assert apart.max() <= 1 + 2 * count
    assert (apart <= 1).mean() > 0.95


def test_the_largest_features_do_not_overflow():
    image = np.zeros((3, 2, 4 * kernels.STEP), np.int64)
    image[:, 0] = 32767
    weights = np.zeros((SUMS, 2, 3, 3), np.int64)
    weights[:, 0], weights[1::2] = 7222, -7222  # nine of them: what `load_network` allows
    one = layer_of(weights, 1e-5, np.zeros(SUMS), 1.0)
    same = layer_of(np.eye(SUMS, dtype=np.int64)[..., None, None], 1.0, np.zeros(SUMS), 1.0)
    found = np.empty((1, SUMS // 2, image.shape[2]), np.int32)
    kernels.convolve_rows(pairs_of(image), (one, same), 0, 1, found)
    expected = np.tile([21298, -21298], SUMS // 2)
    np.testing.assert_array_equal(channels_of(found)[0, :, 0], expected)
    loud = layer_of(weights, 1.0, np.zeros(SUMS), 1.0)
    kernels.convolve_rows(pairs_of(image), (loud, same), 0, 1, found)
    np.testing.assert_array_equal(channels_of(found)[0, :2, 0], [32767, -32767])


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 9))
def test_sizes_come_together_as_interpolated(seed, quads, width):
    rng, height = np.random.default_rng(seed), 4 * quads
    wide = [4 * width // size + 2 * (size > 1) + kernels.STEP for size in (1, 2, 4)]
    parts = [
        rng.integers(-3000, 3000, (height // size + 2 * (size > 1), 4, w))
        for size, w in zip((1, 2, 4), wide, strict=True)
    ]
    sums = parts[0][:, :, : 4 * width].astype(np.float64)
    for size, part in zip((2, 4), parts[1:], strict=True):
        for c in range(4):
            small = part[:, c, : 4 * width // size + 2].astype(np.float32)
            large = cv2.resize(small, None, fx=size, fy=size, interpolation=cv2.INTER_LINEAR)
            sums[:, c] += large[size : size + height, size : size + 4 * width]
    expected = kernels.UNIT * sums / np.sqrt(1 + (sums**2).sum(axis=1, keepdims=True))
    full, half, quarter = (pairs_of(part) for part in parts)
    kernels.unite(full, half, quarter, 0, 1)
    kernels.unite(full, half, quarter, 1, height)
    found = channels_of(full)[:, :, : 4 * width]
    assert np.abs(found - expected).max() <= 1.01  # rounding, and single precision


@given(
    st.integers(0, 2**32 - 1), st.integers(1, 2 * TILE + 3), st.integers(1, 19), st.integers(-5, 5)
)
def test_learned_costs_equal_the_products_of_the_features(seed, width, ndisp, minimum):
    rng = np.random.default_rng(seed)
    views = rng.normal(size=(2, 3, 4, width + 3))
    views /= np.linalg.norm(views, axis=2, keepdims=True)
    views = np.rint(views * kernels.UNIT)
    costs = rng.integers(0, 250, (3, ndisp, width + 5), dtype=np.uint8)
    blend = Blend(learned=60.0, largest=90.0, top=200.0)
    expected, (left, right) = costs.copy(), views[..., :width] / kernels.UNIT
    for k in range(ndisp):
        there = right[:, :, np.clip(np.arange(width) - minimum - k, 0, width - 1)]
        unlike = np.minimum(60 * (1 - (left * there).sum(axis=1)), 90)
        summed = np.minimum(costs[:, k, :width] + unlike + 0.5, 200)
        expected[1:, k, :width] = summed[1:]
    one, other = (pairs_of(view) for view in views)
    add_dissimilarity(one, other, width, minimum, blend, 1, 3, costs)
    assert np.abs(costs.astype(int) - expected).max() <= 1  # halves may be rounded either way
    np.testing.assert_array_equal(costs[0], expected[0])
    np.testing.assert_array_equal(costs[:, :, width:], expected[:, :, width:])


def described_reference(image: np.ndarray, level: float) -> np.ndarray:
    """The network in single precision, as it was trained: float (H, C, W) of unit length."""
    with files("recon.stereo.match").joinpath("features.npz").open("rb") as file:
        weights = dict(np.load(file))
    reach, parts = 24, []
    around = np.pad(
        (image - level) / 32, ((reach, reach + -len(image) % 4), (reach, reach)), "edge"
    )
    for name, size in (("a", 1), ("b", 2), ("d", 4)):
        small = size * cv2.resize(
            around, None, fx=1 / size, fy=1 / size, interpolation=cv2.INTER_AREA
        )
        features = small[None]
        for n in range(5):
            beside = np.pad(features, ((0, 0), (1, 1), (1, 1)))
            windows = sliding_window_view(beside, (3, 3), axis=(1, 2))
            kernel = weights[f"{name}.{n}.weight"]
            features = np.einsum("chwij,ocij->ohw", windows, kernel, optimize=True)
            features += weights[f"{name}.{n}.bias"][:, None, None]
            features = np.where(features > 0, features, 0.1 * features).astype(np.float32)
        enlarged = [
            cv2.resize(one, around.shape[::-1], interpolation=cv2.INTER_LINEAR) for one in features
        ]
        parts.append(np.stack(enlarged))
    found = np.einsum("chw,oc->how", np.concatenate(parts), weights["f.weight"][..., 0, 0])
    found += weights["f.bias"][:, None]
    found = found[reach : reach + image.shape[0], :, reach : reach + image.shape[1]]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="minutes, interpreted")
@pytest.mark.parametrize("contrast", [2.0, 60.0])
def test_sixteen_bits_describe_as_single_precision_does(contrast):
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.normal(size=(47, 60)), (0, 0), 1.2)
    image = np.clip(120 + contrast * image / image.std(), 0, 255).astype(np.float32)
    with ThreadPoolExecutor(2) as pool:
        pairs = Describer(load_network(), image, 118.0).describe(0, 47, pool, 2)
    found = channels_of(pairs)[:, :, :60] / kernels.UNIT
    cosine = (found * described_reference(image, 118.0)).sum(axis=1)
    assert cosine.min() > 0.999
