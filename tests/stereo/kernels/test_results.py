"""What is made of minima equals plain references: refinement, averages, speckles, points."""

import math

import numba
import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from recon.core.kernels.compiled import Bool, Float32, Float64, UInt8, UInt16
from recon.core.values import Reason
from recon.stereo.kernels import refine
from recon.stereo.kernels.finish import average_opposite, count_supporters, find_speckles
from recon.stereo.kernels.minima import NO_COST, Minima
from recon.stereo.kernels.points import MIN_SPREAD, Maps, PointRules, Points, make_points
from recon.stereo.kernels.refine import Refined, Rules, refine_minima, refined_in

RULES = Rules(8, 0, 0.0, 0, left_right=1, window_pixels=25, sigma_floor_px=0.1)


def refine_all(minima: Minima, texture: np.ndarray, rules: Rules) -> Refined:
    shape = minima.winner.shape
    refined = refined_in(np.empty(refine.REFINED_BYTES * minima.winner.size, np.uint8), *shape)
    refine_minima(minima, texture.astype(np.float32), rules, 0, len(texture), refined)
    return refined


@st.composite
def cases(draw: st.DrawFn) -> tuple[Minima, np.ndarray, Rules]:
    height, width = draw(st.tuples(st.integers(1, 4), st.integers(1, 9)))
    ndisp, minimum = draw(st.integers(1, 9)), draw(st.integers(-4, 4))
    x = np.arange(width)
    low = np.clip(x - minimum - (width - 1), 0, ndisp)
    high = np.clip(x - minimum, -1, ndisp - 1)
    ratio = draw(hnp.arrays(np.float64, (height, width), elements=st.floats(0, 1)))
    inside = np.rint(low + ratio * np.maximum(high - low, 0))
    winner = np.where(low <= high, inside, ndisp)
    cost = st.one_of(st.integers(0, 40), st.just(NO_COST))
    costs = np.sort(draw(hnp.arrays(np.uint16, (4, height, width), elements=cost)), axis=0)
    right = draw(hnp.arrays(np.uint16, (height, width), elements=st.integers(0, ndisp)))
    grey = st.one_of(st.floats(0, 4, width=32), st.just(math.nan))
    texture = draw(hnp.arrays(np.float32, (height, width), elements=grey))
    rules = RULES._replace(
        ndisp=ndisp,
        minimum=minimum,
        fit=draw(st.booleans()),
        texture=draw(st.sampled_from([0.0, 2.0])),
        uniqueness=draw(st.sampled_from([0, 15])),
        left_right=draw(st.integers(-1, 1)),
    )
    return Minima(winner.astype(np.uint16), costs, right), texture, rules


LEFT_RIGHT_OR_OCCLUDED = (
    Minima(
        np.array([[2, 3]], np.uint16), np.zeros((4, 1, 2), np.uint16), np.zeros((1, 2), np.uint16)
    ),
    np.zeros((1, 2), np.float32),
    RULES._replace(ndisp=3, minimum=-3, left_right=0, fit=False),
)
"""Once found by chance, where the kernel and its reference gave different reasons."""


@given(cases())
@example(LEFT_RIGHT_OR_OCCLUDED)
def test_refinement_equals_its_reference(case):
    found, expected = refine_all(*case), refine_minima_reference(*case)
    np.testing.assert_array_equal(found.reason, expected.reason)
    # The kernel computes in float32, its reference in float64. Costs are exact in both.
    u = 2.0**-24
    # An offset of 1 at most (two operations), added to a candidate below 13 (the third).
    np.testing.assert_allclose(found.values, expected.values, rtol=0, atol=(2 + 13) * u)
    # Odds: 5 operations for sigma, its cube 17, the margin's 2; half of these under the root, and
    # 3 more. What odds are off by is so much of the confidence, or less; the quotient adds 2.
    np.testing.assert_allclose(found.confidence, expected.confidence, rtol=0, atol=16 * u)
    # The variance is off by so much of that of a wrong disparity, and by 12 operations of its own.
    wrong = np.maximum(expected.sigma_px, refine.WRONG_PX) ** 2
    variance_off = 16 * u * wrong + 12 * u * expected.sigma_px**2
    known = expected.reason == refine.VALID
    sigma_off = np.abs(found.sigma_px - expected.sigma_px)[known]
    bound = variance_off / (2 * expected.sigma_px) + 2 * u * expected.sigma_px
    assert (sigma_off <= bound[known]).all()


@given(cases())
def test_results_lie_within_their_bounds(case):
    minima, _, rules = case
    refined = refine_all(*case)
    kept = refined.reason == refine.VALID
    np.testing.assert_array_equal(np.isfinite(refined.values), kept)
    np.testing.assert_array_equal(np.isfinite(refined.sigma_px), kept)
    assert (refined.confidence[~kept] == 0).all()
    assert ((refined.confidence >= 0) & (refined.confidence <= 1)).all()
    # The floor is float64 in the rules and float32 in the result.
    assert (refined.sigma_px[kept] >= np.float32(rules.sigma_floor_px)).all()
    assert (refined.sigma_px[kept] <= refine.SIGMA_LARGEST_PX).all()
    whole = minima.winner[kept] + float(rules.minimum)
    assert (np.abs(refined.values[kept] - whole) <= 0.5).all()


def refine_minima_reference(minima: Minima, texture: Float32, rules: Rules) -> Refined:
    reason = _reasons(minima, texture, rules)
    keep = reason == Reason.VALID
    best, before, after, second = minima.costs.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = rules.minimum + minima.winner.astype(np.float64)
        values += _offsets(best, before, after, rules.fit)
        sigma = _sigmas(best, before, after, rules)
        margin = (second - best) / (rules.window_pixels + best)
        odds = rules.odds * np.sqrt(margin / (sigma * sigma * sigma))
        confidence = np.where(second < NO_COST, odds / (odds + 1.0), 0.0)
        if_wrong = np.maximum(sigma, refine.WRONG_PX)
        mixed = np.sqrt(confidence * sigma**2 + (1.0 - confidence) * if_wrong**2)
    return Refined(
        values=np.where(keep, values, np.nan).astype(np.float32),
        confidence=np.where(keep, confidence, 0.0).astype(np.float32),
        sigma_px=np.where(keep, mixed, np.nan).astype(np.float32),
        reason=reason,
    )


def _reasons(minima: Minima, texture: Float32, rules: Rules) -> UInt8:
    k = minima.winner.astype(np.int64)
    best, before, after, second = minima.costs.astype(np.int64)
    width = k.shape[1]
    right = np.arange(width) - rules.minimum - k
    place = np.clip(right, 0, width - 1)
    other = np.take_along_axis(minima.right_winner.astype(np.int64), place, axis=1)
    differs = (rules.left_right >= 0) & (np.abs(other - k) > rules.left_right)
    inside = (right > 0) & (right < width - 1)
    chosen = _chosen_beside(minima.right_winner, rules)
    ends = np.maximum(before, after) == NO_COST
    close = 100 * second <= best * (100 + rules.uniqueness)
    cases = [
        ((k == rules.ndisp) | np.isnan(texture), Reason.BORDER),
        (texture < rules.texture, Reason.LOW_TEXTURE),
        (ends & ((k == 0) | (k == rules.ndisp - 1) | inside), Reason.OUT_OF_RANGE),
        (ends, Reason.BORDER),
        (differs & chosen, Reason.LEFT_RIGHT),
        (differs, Reason.OCCLUDED),
        ((rules.uniqueness > 0) & close, Reason.AMBIGUOUS),
    ]
    conditions, codes = zip(*cases, strict=True)
    return np.asarray(np.select(conditions, codes, Reason.VALID), dtype=np.uint8)


def _chosen_beside(right_winner: UInt16, rules: Rules) -> Bool:
    height, width = right_winner.shape
    x = np.arange(width) + rules.minimum + right_winner.astype(np.int64)
    chosen = np.zeros((height, width), np.bool_)
    for aside in (-1, 0, 1):
        seen = (right_winner != rules.ndisp) & (x + aside >= 0) & (x + aside < width)
        chosen[np.nonzero(seen)[0], (x + aside)[seen]] = True
    return chosen


def _offsets(best: Float64, before: Float64, after: Float64, fit: bool) -> Float64:
    slope = np.maximum(before, after) - best
    return np.where(fit & (slope > 0), 0.5 * (before - after) / slope, 0.0)


def _sigmas(best: Float64, before: Float64, after: Float64, rules: Rules) -> Float64:
    slope = np.maximum(before, after) - best
    vertex = np.maximum(best - 0.5 * np.abs(before - after), 0.0)
    noise = 0.5 * np.pi * vertex / (slope * np.sqrt(rules.window_pixels))
    sigma = np.sqrt(rules.sigma_floor_px**2 + noise * noise)
    return np.where(slope > 0, np.minimum(sigma, refine.SIGMA_LARGEST_PX), refine.SIGMA_LARGEST_PX)


nan, shapes = st.just(math.nan), st.tuples(st.integers(1, 9), st.integers(1, 9))
smooth = hnp.arrays(np.float32, shapes, elements=st.floats(0, 3, width=16) | nan)
steps = hnp.arrays(np.float32, shapes, elements=st.sampled_from([0.0, 0.5, 1.0, 2.5, 4.0]) | nan)


def average_reference(values: Float32, radius: int, largest_step: float) -> Float64:
    """Return `average_opposite` of all rows, one pixel after the other."""
    averages, side = np.full(values.shape, np.nan), 2 * radius + 1
    chessboard = np.indices((side, side)).sum(axis=0) % 2 == 0
    padded = np.pad(values.astype(float), radius, constant_values=np.nan)
    for y, x in zip(*np.nonzero(np.isfinite(values)), strict=True):
        near = padded[y : y + side, x : x + side].copy()
        near[~(np.abs(near - values[y, x]) <= largest_step) | ~chessboard] = np.nan
        # Turned by half a turn, each neighbour lies on its opposite; the pixel on itself.
        near[np.isnan(near[::-1, ::-1])] = np.nan
        averages[y, x] = np.nanmean(near)
    return averages


def average(values: Float32, radius: int = 3, largest_step: float = 1.0) -> Float32:
    averages, middle = np.full_like(values, -1.0), len(values) // 2
    for first, end in ((0, middle), (middle, len(values))):
        average_opposite(values, radius, largest_step, first, end, averages)
    return averages


@given(smooth, st.integers(0, 4), st.sampled_from([0.25, 1.0, 5.0]))
def test_averages_equal_those_of_the_reference(values, radius, step):
    # float32: up to 40 pairs, each added up and added on, and a division, of values up to 3.
    rounding, expected = 42 * 2.0**-24 * 3, average_reference(values, radius, step)
    np.testing.assert_allclose(average(values, radius, step), expected, rtol=0, atol=rounding)


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), hnp.arrays(np.bool_, (12, 14)))
def test_slope_with_holes_stays_as_it_is(across, down, holes):
    y, x = np.mgrid[:12, :14]
    slope = np.where(holes, np.nan, 20 + across * x + down * y).astype(np.float32)
    # float32 values below 28: the slope's own rounding, and 24 pairs added up.
    rounding = (2 + 26) * 2.0**-24 * 28
    np.testing.assert_allclose(average(slope, largest_step=5.0), slope, rtol=0, atol=rounding)


def speckles_reference(values: Float32, largest_step: float, smallest_size: int) -> Bool:
    """Return `find_speckles`, by flooding one region after the other."""
    small, todo = np.zeros(values.shape, np.bool_), np.isfinite(values)
    while todo.any():
        seed = np.unravel_index(int(np.argmax(todo)), values.shape)
        region, waiting = np.zeros(values.shape, np.bool_), [(int(seed[0]), int(seed[1]))]
        region[seed] = True
        while waiting:
            y, x = waiting.pop()
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                inside = 0 <= v < values.shape[0] and 0 <= u < values.shape[1]
                if inside and not region[v, u] and abs(values[v, u] - values[y, x]) <= largest_step:
                    region[v, u] = True
                    waiting.append((v, u))
        todo &= ~region
        small |= region & (region.sum() < smallest_size)
    return small


@given(steps, st.sampled_from([0.5, 1.0, 2.0]), st.integers(0, 20))
def test_speckles_equal_those_of_the_reference(values, step, size):
    found = find_speckles(values, step, size)
    np.testing.assert_array_equal(found, speckles_reference(values, step, size))


@given(steps, st.integers(1, 2), st.integers(0, 2**16))
def test_supporters_equal_those_of_the_reference(values, radius, seed):
    height, width = values.shape
    side = 2 * radius + 1
    limits = np.random.default_rng(seed).integers(0, 4, (side, side)).astype(np.float32) / 2
    padded = np.pad(values, radius, constant_values=np.nan)
    expected = np.ones(values.shape, np.uint8)
    for v, u, dy, dx in np.ndindex(height, width, side, side):
        if (dy, dx) != (radius, radius):
            away = abs(values[v, u] - padded[v + dy, u + dx])
            expected[v, u] += away <= limits[dy, dx]
    np.testing.assert_array_equal(count_supporters(padded, limits), expected)


POINT_RULES = PointRules(100.0, 12.3, 7.7, 20.0, 2.0, 0.1, 8.0, 0.2, stride=1, radius=3)


def make_maps(seed: int, height: int, width: int, *, known: float, channels: int) -> Maps:
    """A slanted surface with noise, steps, holes, negative values."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    values = 6 + 0.3 * u - 0.2 * v + np.where(u > width // 2, 9.0, 0.0)
    values += rng.normal(0, 0.3, values.shape)
    values[rng.random(values.shape) < 0.05] = -3.0
    values[rng.random(values.shape) > known] = np.nan
    made = Maps(
        values.astype(np.float32),
        rng.random(values.shape).astype(np.float32),
        rng.uniform(0.05, 0.6, values.shape).astype(np.float32),
        rng.integers(0, 256, (height, width, channels), dtype=np.uint8),
        rng.random(values.shape) < 0.9 if channels == 3 else np.zeros((0, 0), np.bool_),
    )
    for image in made[:-1]:
        image.flags.writeable = False  # as those of a disparity: kernels are compiled for them
    return made


maps = st.builds(
    make_maps,
    seed=st.integers(0, 2**20),
    height=st.integers(1, 20),
    width=st.integers(1, 30),
    known=st.sampled_from([0.0, 0.1, 0.6, 1.0]),
    channels=st.sampled_from([1, 3]),
)


@given(maps, st.integers(0, 4), st.integers(1, 3))
@settings(max_examples=150)
def test_points_equal_their_reference(given_maps, radius, stride):
    rules = POINT_RULES._replace(radius=radius, stride=stride)
    ours = make_points(given_maps, rules)
    reference = make_points_reference(given_maps, rules)
    # Both compute in float64 and round to float32 at the end: to its next value at most.
    rtol, atol = 2.0**-23, 0.0
    if numba.config.DISABLE_JIT:
        # numpy then does each of three operations in float32, and first rounds the principal point
        # (below 32 px) to it; that is multiplied by depth (below 10 m) over focal length (100 px).
        rtol, atol = 4 * 2.0**-23, 32 * 2.0**-24 * 10 / 100
    np.testing.assert_allclose(ours.xyz, reference.xyz, rtol=rtol, atol=atol)
    np.testing.assert_allclose(ours.sigma, reference.sigma, rtol=2.0**-23)
    np.testing.assert_array_equal(ours.confidence, reference.confidence)
    np.testing.assert_array_equal(ours.colours, reference.colours)
    # The kernel adds up to 81 disparities below 26 px in float32, each within 4 px of the centre,
    # in 18 steps: a covariance is off by 38 · 2^-24 · 4 · 26 = 2.4e-4 at most, a slope by that over
    # the window's variance across its narrow side (0.2 where few pixels are known: 1.2e-3), and the
    # direction by 100 (the focal length) times that over the normal's length (60 on this slope).
    np.testing.assert_allclose(ours.normals, reference.normals, atol=2e-3)


Index = tuple[NDArray[np.intp], NDArray[np.intp]]


def make_points_reference(maps: Maps, rules: PointRules) -> Points:
    rows, columns = np.nonzero(_candidates(maps, rules))
    with np.errstate(divide="ignore"):
        z = (rules.fb / (maps.values[rows, columns].astype(np.float64) + rules.doffs)).astype("f4")
        error = (z.astype(np.float64) ** 2 * maps.sigma[rows, columns] / rules.fb).astype("f4")
    keep = (z >= rules.nearest) & (z <= rules.farthest)
    with np.errstate(invalid="ignore"):
        keep &= error <= rules.relative_sigma * z.astype(np.float64)
    rows, columns, z, error = rows[keep], columns[keep], z[keep], error[keep]
    colours = maps.colours[rows, columns]
    return Points(
        xyz=np.stack(
            [(columns - rules.cx) * z / rules.focal, (rows - rules.cy) * z / rules.focal, z], axis=1
        ).astype(np.float32),
        normals=_normals(maps.values, (rows, columns), rules)
        if rules.radius
        else np.zeros((0, 3), np.float32),
        sigma=error,
        confidence=maps.confidence[rows, columns],
        colours=np.repeat(colours, 3, axis=1) if colours.shape[1] == 1 else colours,
    )


def _candidates(maps: Maps, rules: PointRules) -> Bool:
    with np.errstate(invalid="ignore"):
        candidates = maps.values.astype(np.float64) + rules.doffs > 0
    if maps.usable.size:
        candidates &= maps.usable
    raster = np.zeros_like(candidates)
    raster[:: rules.stride, :: rules.stride] = True
    return np.asarray(candidates & raster)


def _normals(values: Float32, at: Index, rules: PointRules) -> Float32:
    slope_u, slope_v = _slopes(values, at, rules.radius)
    rows, columns = at
    centre = values[at] + rules.doffs - slope_u * (columns - rules.cx)
    centre -= slope_v * (rows - rules.cy)
    normals = -np.stack([slope_u * rules.focal, slope_v * rules.focal, centre], axis=1)
    length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.asarray(normals / length, dtype=np.float32)


def _slopes(values: Float32, at: Index, radius: int) -> tuple[Float64, Float64]:
    """Disparity gradients (along u, along v) of the plane fitted to the window of each pixel."""
    padded = np.pad(values.astype(np.float64), radius, constant_values=np.nan)
    offset = np.arange(-radius, radius + 1)
    rows = at[0][:, None, None] + radius + offset[:, None]
    columns = at[1][:, None, None] + radius + offset
    d = padded[rows, columns].reshape(len(at[0]), offset.size**2)
    du, dv = (a.ravel()[None] for a in np.meshgrid(offset, offset))
    known = np.isfinite(d)
    n = known.sum(axis=1, keepdims=True)

    def centred(x: NDArray[np.floating | np.integer]) -> Float64:
        x = np.where(known, x, 0.0).astype(np.float64)
        return np.where(known, x - x.sum(axis=1, keepdims=True) / n, 0.0)

    u, v, d = centred(du), centred(dv), centred(d)
    uu, vv, uv, ud, vd = (
        (a * b).sum(axis=1) / n[:, 0] for a, b in ((u, u), (v, v), (u, v), (u, d), (v, d))
    )
    determinant = uu * vv - uv**2
    flat = determinant > MIN_SPREAD
    inverse = np.where(flat, 1.0, 0.0) / np.where(flat, determinant, 1.0)
    return (ud * vv - vd * uv) * inverse, (vd * uu - ud * uv) * inverse
