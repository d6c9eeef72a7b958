"""The compiled searches equal their references: plain numpy, slow, short, what results mean."""

import itertools

import cv2
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.kernels.compiled import Bool, Int64, UInt8, UInt16
from recon.stereo.kernels import half_windows, semi_global
from recon.stereo.kernels.half_windows import GROUP, Support, Tiles, make_tiles, offer_supported
from recon.stereo.kernels.minima import NO_COST, Minima, empty_minima
from recon.stereo.kernels.path_costs import (
    CENSUS_RADIUS,
    GRADIENT_CAP,
    PLANES,
    Views,
    Window,
    empty_planes,
    scaled_window,
    window_costs,
    write_planes,
    write_views,
)
from recon.stereo.kernels.paths import Paths
from recon.stereo.kernels.plane_minima import PARTS, Band
from recon.stereo.kernels.sad import sad_minima
from recon.stereo.kernels.simd.vectors import LANES

Pair = tuple[UInt8, UInt8]


@st.composite
def pairs(draw: st.DrawFn, rows: tuple[int, int], columns: tuple[int, int]) -> Pair:
    shape = draw(st.tuples(st.integers(*rows), st.integers(*columns)))
    # Few grey levels make ties, many make overflows.
    grey = hnp.arrays(np.uint8, shape, elements=st.integers(0, draw(st.sampled_from([1, 3, 255]))))
    return draw(grey), draw(grey)


def assert_equal(found: Minima, expected: Minima) -> None:
    for name in Minima._fields:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)


def sad_minima_reference(left, right, search, tiles):
    upright = window_costs_reference(left, right, search._replace(slant=0))
    slanted = window_costs_reference(left, right, search)
    lowest = np.minimum(upright, slanted)
    offered = offered_reference(tiles, left.shape, search.ndisp)
    minima = minima_reference(np.where(offered, lowest, NO_COST), search.minimum)
    k = np.minimum(minima.winner, search.ndisp - 1).astype(np.int64)[:, :, None]
    own = np.where(np.take_along_axis(slanted < upright, k, axis=2), slanted, upright)
    for n, step in ((1, -1), (2, 1)):
        there = np.clip(k + step, 0, search.ndisp - 1)
        cost = np.take_along_axis(own, there, axis=2)[:, :, 0]
        minima.costs[n] = np.where(minima.costs[n] == NO_COST, NO_COST, cost)
    return minima._replace(right_winner=right_winners_reference(minima, search))


def window_costs_reference(left: UInt8, right: UInt8, search: half_windows.Search) -> Int64:
    """int64 (H, W, ndisp), the cost of each candidate, as if both images went on for ever."""
    height, width = left.shape
    costs = np.zeros((height, width, search.ndisp), np.int64)
    candidates = search.minimum + np.arange(search.ndisp)
    y, x = np.arange(height), np.arange(width)
    reach = search.rows_radius
    upper = [(dy, -search.slant) for dy in range(-reach, 1)]
    lower = [(dy, search.slant) for dy in range(reach + 1)]
    for dy, slant in upper + lower:
        rows = np.clip(y + dy, 0, height - 1)[:, None]
        for dx in range(-search.radius, search.radius + 1):
            columns = np.clip(x + dx, 0, width - 1)
            others = np.clip(x[:, None] + dx - candidates - slant, 0, width - 1)
            a = np.expand_dims(left[rows, columns].astype(np.int64), 2)
            b = right[np.expand_dims(rows, 2), others[None]].astype(np.int64)
            costs += np.minimum(np.abs(a - b), search.cost_cap)
    return costs


def right_winners_reference(minima: Minima, search: half_windows.Search) -> UInt16:
    """uint16 (H, W), the candidate of the left pixel that chose each right pixel at least cost."""
    chosen = np.full_like(minima.winner, search.ndisp)
    x_last_first = -np.arange(chosen.shape[1])
    for y, costs in enumerate(minima.costs[0].astype(np.int64)):
        # The last one written stands: that of the least cost, and of equal ones the leftmost.
        for x in np.lexsort((x_last_first, -costs)):
            k = int(minima.winner[y, x])
            if k < search.ndisp:
                chosen[y, x - search.minimum - k] = k
    return chosen


def minima_reference(costs: Int64, minimum: int) -> Minima:
    """Return the minima of costs (H, W, ndisp) in both views; `NO_COST` = not offered."""
    width, ndisp = costs.shape[1:]
    k = np.arange(ndisp)
    x = np.arange(width)[:, None]
    inside = (x - minimum - k >= 0) & (x - minimum - k < width) & (costs < NO_COST)
    open_costs = np.where(inside, costs, NO_COST)
    winner = np.where(inside.any(axis=2), open_costs.argmin(axis=2), ndisp)
    after = np.where(winner < ndisp, winner + 1, ndisp)
    beside = [_cost_at(open_costs, place) for place in (winner, winner - 1, after)]
    second = np.where(np.abs(k - winner[:, :, None]) < 2, NO_COST, open_costs).min(axis=2)
    picked = np.stack([*beside, second])
    # Column x_right of the right view sees left column x_right + minimum + k as candidate k.
    seen = x + minimum + k
    clipped = np.clip(seen, 0, width - 1)
    right_costs = np.where(seen == clipped, costs[:, clipped, k], NO_COST)
    right = np.where((seen == clipped).any(axis=1), right_costs.argmin(axis=2), ndisp)
    return Minima(winner.astype(np.uint16), picked.astype(np.uint16), right.astype(np.uint16))


def _cost_at(costs: Int64, k: Int64) -> Int64:
    """Return costs (H, W) of one candidate of each pixel; `NO_COST` outside the range."""
    ndisp = costs.shape[2]
    there = np.clip(k, 0, ndisp - 1)[:, :, None]
    cost = np.take_along_axis(costs, there, axis=2)[:, :, 0]
    return np.where((k >= 0) & (k < ndisp), cost, NO_COST)


def semi_global_minima_reference(views, window, paths, bands=None):
    """Return all rows of `semi_global_minima`, as one block, in columns divided into bands."""
    costs, width = path_costs_reference(views, window, paths.ndisp), views.grey.shape[1]
    parts = [
        _path_means(views.grey[:, start:end], costs[:, start:end], paths)[
            :, first - start : last - start
        ]
        for start, end, first, last in bands or [Band(0, width, 0, width)]
    ]
    return minima_reference(PARTS * np.concatenate(parts, axis=1), paths.minimum)


def _path_means(grey: UInt8, costs: Int64, paths: Paths) -> Int64:
    def along(dy: int, dx: int) -> Int64:
        return path_reference(grey, costs, paths, dy, dx)

    down, up = (_mean(along(dy, 0), _mean(along(dy, 1), along(dy, -1))) for dy in (1, -1))
    return _mean(_mean(along(0, 1), along(0, -1)), _mean(down, up))


def _mean(a: Int64, b: Int64) -> Int64:
    return (a + b + 1) >> 1


def path_costs_reference(views: Views, window: Window, ndisp: int) -> Int64:
    """Return int64 (H, W, P), the cost of each candidate at each pixel."""
    height, width = views.grey.shape
    x, k = np.arange(views.left.shape[2])[:, None], np.arange(ndisp)
    left, right = views.left[..., None], views.right[:, :, x - k + ndisp - 1]
    pixels = np.minimum(abs(left[:, 0].astype(np.int64) - right[:, 0]), window.gradient_cap)
    differ = left[:, 1:] ^ right[:, 1:]
    pixels = pixels + np.unpackbits(differ[..., None], axis=-1).sum(axis=(1, -1), dtype=np.int64)
    across = sum(pixels[:, dx : dx + width] for dx in range(2 * window.radius + 1))
    across = np.asarray(across) >> window.row_shift
    sums, rows = np.zeros(across.shape, np.int64), np.arange(height)
    for dy in range(-window.rows_radius, window.rows_radius + 1):
        sums += across[np.clip(rows + dy, 0, height - 1)]
    return sums * window.factor >> window.shift


def path_reference(grey: UInt8, costs: Int64, paths: Paths, dy: int, dx: int) -> Int64:
    """Return int64 (H, W, P), costs of the paths that step by ``(dy, dx)`` to each pixel."""
    height, width, candidates = costs.shape
    closed = np.full(candidates + 2, 255 - paths.p1)
    result: Int64 = costs.copy()
    for y in range(height) if dy >= 0 else range(height - 1, -1, -1):
        for x in range(width) if dx >= 0 else range(width - 1, -1, -1):
            if not (0 <= y - dy < height and 0 <= x - dx < width):
                continue
            before = result[y - dy, x - dx]
            closed[1:-1] = before
            edge = abs(int(grey[y, x]) - int(grey[y - dy, x - dx])) > paths.edge
            p2 = paths.p2_at_edge if edge else paths.p2
            beside = np.minimum(closed[:-2], closed[2:]) + paths.p1
            least = np.minimum(np.minimum(before, beside), before.min() + p2)
            result[y, x] = costs[y, x] + least - before.min()
    return result


def offer_supported_reference(halved, minimum, ndisp, support, tiles):
    y = 2 * np.arange(halved.shape[0])[:, None]
    x = 2 * np.arange(halved.shape[1])[None, :]
    k = np.clip(np.rint(2 * halved) - minimum, 0, ndisp - 1)
    offered = np.zeros_like(tiles.offered)
    for i, j, group in np.ndindex(*offered.shape):
        top, left = i * tiles.height - support.margin_y, j * tiles.width - support.margin_x
        bottom = (i + 1) * tiles.height + support.margin_y
        right = (j + 1) * tiles.width + support.margin_x
        seen = (y // 2 >= top // 2) & (y // 2 < bottom // 2)
        seen = seen & (x // 2 >= left // 2) & (x // 2 < right // 2)
        matched = np.count_nonzero(seen & np.isfinite(halved))
        near = (k >= group * GROUP - support.margin) & (k < (group + 1) * GROUP + support.margin)
        enough = np.count_nonzero(seen & near) >= max(support.ratio * matched, support.least)
        offered[i, j, group] = enough or matched < support.matched * np.count_nonzero(seen)
    return offered


def offered_reference(tiles: Tiles, shape: tuple[int, int], ndisp: int) -> Bool:
    """Return bool (H, W, ndisp), which candidates are offered to which pixel."""
    y, x = np.arange(shape[0]) // tiles.height, np.arange(shape[1]) // tiles.width
    return tiles.offered[y[:, None, None], x[:, None], np.arange(ndisp) // GROUP]


NDISP = 40


supports = st.builds(
    Support,
    margin_x=st.integers(0, 9),
    margin_y=st.integers(0, 9),
    margin=st.integers(0, 9),
    matched=st.sampled_from([0.0, 0.3, 1.0]),
    ratio=st.sampled_from([0.0, 0.1, 0.6]),
    least=st.integers(0, 5),
)
disparities = st.one_of(st.just(np.nan), st.integers(-4, 30))


@given(
    hnp.arrays(np.float32, st.tuples(st.integers(1, 20), st.integers(1, 30)), elements=disparities),
    st.integers(-9, 9),
    supports,
)
def test_support_equals_the_reference(halved, minimum, support):
    tiles = make_tiles((2 * halved.shape[0], 2 * halved.shape[1]), (8, 16), NDISP)
    rows = len(tiles.offered)
    for first, end in ((0, rows // 2), (rows // 2, rows)):
        offer_supported(halved, minimum, NDISP, support, first, end, tiles)
    expected = offer_supported_reference(halved, minimum, NDISP, support, tiles)
    np.testing.assert_array_equal(tiles.offered, expected)


def everything(shape: tuple[int, int], search: half_windows.Search) -> Tiles:
    return make_tiles(shape, (shape[0], half_windows.widest_block(search, shape[1])), search.ndisp)


def search_all(pair: Pair, search: half_windows.Search, tiles: Tiles, strips: int = 1) -> Minima:
    minima, (left, right) = empty_minima(*pair[0].shape), pair
    views = half_windows.empty_views(search, tiles.width, *left.shape)
    half_windows.lay_out(left, right, search, 0, views)
    scratch = half_windows.empty_scratch(search, tiles.width)
    edges = np.linspace(0, len(left), strips + 1).astype(int)
    for first, end in itertools.pairwise(edges):
        sad_minima(views, search, tiles, int(first), int(end), scratch, minima)
    return minima


searches = st.builds(
    half_windows.Search,
    ndisp=st.integers(1, 28),
    minimum=st.integers(-16, 16),
    radius=st.integers(0, 4),
    rows_radius=st.integers(0, 4),
    cost_cap=st.sampled_from([1, 20, 255]),
    slant=st.integers(-2, 2),
)


@st.composite
def tilings(draw: st.DrawFn, shape: tuple[int, int], search: half_windows.Search) -> Tiles:
    height = draw(st.integers(max(search.rows_radius, 1), 9))
    tiles = make_tiles(shape, (height, draw(st.integers(1, 40))), search.ndisp)
    return tiles._replace(offered=draw(hnp.arrays(np.bool_, tiles.offered.shape)))


@given(st.data(), pairs((1, 14), (1, 40)), searches, st.integers(0, 4))
def test_sad_equals_the_reference_and_what_is_not_offered_does_not_exist(
    data, pair, search, strips
):
    shape = pair[0].shape
    tiles = data.draw(tilings(shape, search)) if strips else everything(shape, search)
    found = search_all(pair, search, tiles, max(1, min(strips, shape[0])))
    assert_equal(found, sad_minima_reference(*pair, search, tiles))


@pytest.mark.parametrize("slant", [0, 1, -2])
@pytest.mark.parametrize(("ndisp", "minimum"), [(64, 0), (65, -40), (33, 20), (100, 60)])
def test_wide_images_are_searched_in_vectors(ndisp, minimum, slant):
    rng = np.random.default_rng(ndisp + slant)
    # Few grey levels, so that vectors and runs have equal costs to decide between.
    left, right = rng.integers(0, 4, (2, 5, 3 * LANES + 35), dtype=np.uint8)
    search = half_windows.Search(ndisp, minimum, 2, 1, cost_cap=2, slant=slant)
    assert ndisp + 2 * abs(slant) > LANES
    tiles = everything(left.shape, search)
    expected = sad_minima_reference(left, right, search, tiles)
    assert_equal(search_all((left, right), search, tiles), expected)


# One row: the sums over a column fit into bytes, those over two do not.
@pytest.mark.parametrize(("radius", "rows_radius"), [(7, 7), (1, 0), (4, 0)])
def test_largest_costs_do_not_overflow(radius, rows_radius):
    pair = np.full((40, 40), 255, np.uint8), np.zeros((40, 40), np.uint8)
    search = half_windows.Search(3, 0, radius, rows_radius, cost_cap=255, slant=0)
    costs = search_all(pair, search, everything((40, 40), search)).costs[0]
    assert (costs == (2 * radius + 1) * 2 * (rows_radius + 1) * 255).all()
    assert costs.max() < NO_COST


greys = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12))


def planes_reference(grey: UInt8) -> UInt8:
    """Return uint8 (PLANES, H, W) as `write_planes` writes them; gradients are those of OpenCV."""
    (height, width), side = grey.shape, 2 * CENSUS_RADIUS + 1
    sobel = cv2.Sobel(grey, cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE)
    gradient = np.clip(sobel, -GRADIENT_CAP, GRADIENT_CAP) + GRADIENT_CAP
    around = np.pad(grey, CENSUS_RADIUS, mode="edge")
    places = [(dy, dx) for dy, dx in np.ndindex(side, side) if (dy, dx) != (CENSUS_RADIUS,) * 2]
    darker = [around[dy : dy + height, dx : dx + width] < grey for dy, dx in places]
    bits = np.packbits(np.stack(darker), axis=0, bitorder="little")
    return np.concatenate([gradient[None].astype(np.uint8), bits])


def planes_of(grey: UInt8, place: int, size: int) -> UInt8:
    grey.flags.writeable = False  # as that of a pair: kernels are compiled for it
    planes = np.full((len(grey), PLANES, size), 77, np.uint8)
    write_planes(grey, place, 0, len(grey), planes)
    return planes.transpose(1, 0, 2)


@given(greys, st.integers(-30, 40), st.integers(1, 30))
def test_planes_equal_the_reference_and_go_on_beyond(grey, place, size):
    columns = np.clip(np.arange(size) - place, 0, grey.shape[1] - 1)
    expected = planes_reference(grey)[:, :, columns]
    np.testing.assert_array_equal(planes_of(grey, place, size), expected)


def make_views(pair: Pair, window: Window, paths: Paths) -> Views:
    for image in pair:
        image.flags.writeable = False  # as those of a pair: kernels are compiled for them
    left, right = pair
    views = Views(left, *empty_planes(*left.shape, window.radius, paths.ndisp))
    write_views(right, window.radius, paths.minimum, range(len(left)), views)
    return views


def sweep(views, window, paths, strips=1, columns=None):
    minima = empty_minima(*views.grey.shape)
    edges = np.linspace(0, len(views.grey), strips + 1).astype(int).tolist()
    for first, end in itertools.pairwise(edges):
        scratch = semi_global.empty_scratch(views.grey.shape[1], paths)
        if columns:
            memory = np.zeros(semi_global.scratch_bytes(columns, paths), np.uint8)
            scratch = semi_global.Scratch(memory, columns)
        write = window_costs(views, window, scratch.columns)
        semi_global.semi_global_minima(
            views.grey, write, window.radius, paths, range(first, end), scratch, minima
        )
    return minima


@st.composite
def windows(draw: st.DrawFn) -> tuple[Window, Paths]:
    radius, rows_radius = draw(st.tuples(st.integers(0, 3), st.integers(0, 3)))
    cap = draw(st.sampled_from([0, 16, 120]))
    p1, more = draw(st.tuples(st.integers(1, 40), st.integers(0, 80)))
    # The largest that a path cost leaves: cost + P1 + P2 <= 254.
    top = 254 - 2 * p1 - more
    window = scaled_window(radius, rows_radius, cap, cap + 24, top / (cap + 24))
    ndisp = draw(st.sampled_from([1, 2, 3, 4, 5, 17, 70, 260]))
    minimum, edge = draw(st.integers(-6, 6)), draw(st.sampled_from([0, 12, 255]))
    return window, Paths(ndisp, minimum, p1, p1 + more, p1, edge, overlap=100, side_overlap=100)


@settings(max_examples=70)
@given(pairs((1, 7), (1, 9)), windows(), st.integers(1, 4))
def test_semi_global_search_equals_the_reference_in_strips_that_overlap_wholly(pair, rules, strips):
    views = make_views(pair, *rules)
    assert_equal(sweep(views, *rules, strips), semi_global_minima_reference(views, *rules))


@pytest.mark.parametrize("shape", [(3 * semi_global.ROWS + 5, 70), (2 * semi_global.ROWS, 64)])
@pytest.mark.parametrize("overlap", [4 * semi_global.ROWS, 2 * semi_global.ROWS + 1])
def test_images_of_several_blocks_equal_the_reference(shape, overlap):
    """Paths from above go on from block to block; those from below reach through all below."""
    pair = tuple(np.random.default_rng(1).integers(0, 256, (2, *shape), dtype=np.uint8))
    paths = Paths(9, -2, 10, 50, 20, 12, overlap=max(overlap, shape[0]), side_overlap=70)
    window = scaled_window(1, 2, 16, 40, 3.0)
    views = make_views(pair, window, paths)
    expected = semi_global_minima_reference(views, window, paths)
    assert_equal(sweep(views, window, paths, strips=2), expected)


@pytest.mark.parametrize("minimum", [-70, 0, 3])
@pytest.mark.parametrize("side_overlap", [0, 9])
def test_bands_equal_the_reference_that_begins_at_sides(minimum, side_overlap):
    """The right view is put together from all bands."""
    rows = 2 if numba.config.DISABLE_JIT else 9
    left, right = np.random.default_rng(2).integers(0, 256, (2, rows, 300), dtype=np.uint8)
    right[:, :200] = left[:, 20:220]
    paths = Paths(70, minimum, 10, 50, 20, 12, overlap=rows, side_overlap=side_overlap)
    window = scaled_window(2, 2, 16, 40, 3.0)
    views = make_views((left, right), window, paths)
    for strips, columns in ((1, 64), (2, 128)):
        bands = semi_global.bands_of(300, columns, window.radius, paths)
        expected = semi_global_minima_reference(views, window, paths, bands)
        assert len(bands) > 1
        assert_equal(sweep(views, window, paths, strips, columns), expected)


@given(st.integers(0, 15), st.integers(0, 15), st.integers(1, 207), st.floats(0.05, 6.0))
def test_a_scaled_window_stays_in_its_bits(radius, rows_radius, largest, levels):
    window = scaled_window(radius, rows_radius, 14, largest, min(levels, 250 / largest))
    across = ((2 * radius + 1) * largest) >> window.row_shift
    most = across * (2 * rows_radius + 1)
    assert across <= 255
    assert most * window.factor <= 65535
    assert most * window.factor >> window.shift == window.top <= 250
    # What is said of the scale is what the largest cost becomes, but for bits that were cut.
    assert window.levels * largest == pytest.approx(window.top, rel=0.1, abs=1.5)
