"""Fits of planes, and the search among them, beside plain loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.stereo.kernels import planes
from recon.stereo.kernels.simd.vectors import WIDE

COLOURS = np.ones(766, np.float32)  # all colours count alike
CHANGES = planes.Changes(
    per_px=3.0, most=10.0, most_at_edge=4.0, edge=12, outside=200.0, minimum=-1
)


def fitted(values, weights=None, guide=None, alike=COLOURS, radius=8):
    height, width = values.shape
    nodes = np.empty((3, -(-height // planes.NODE_PX), -(-width // planes.NODE_PX)), np.float32)
    weights = np.ones_like(values) if weights is None else weights
    guide = np.zeros((height, width, 3), np.uint8) if guide is None else guide
    planes.fit_nodes(values, weights, guide, alike, radius, 1, 1.0, 0, nodes.shape[1], nodes)
    return nodes


def slanted(height=40, width=48, across=0.2, down=-0.1):
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return (20 + across * x + down * y).astype(np.float32)


def test_planes_are_fitted_through_noise_holes_and_a_second_surface():
    rng = np.random.default_rng(0)
    truth = slanted()
    seen = truth + rng.normal(0, 0.1, truth.shape).astype(np.float32)
    seen[rng.random(seen.shape) < 0.2] = np.nan
    seen[:, 30:] += 8
    nodes = fitted(seen)
    known = np.isfinite(nodes[0])
    assert known.mean() > 0.7
    assert np.isnan(seen[:: planes.NODE_PX, :: planes.NODE_PX][~known]).all()
    inner = known.copy()
    inner[:, 5:10] = inner[:2] = inner[-2:] = inner[:, :2] = inner[:, -2:] = False
    assert np.abs(nodes[1][inner] - 0.2).max() < 0.03
    assert np.abs(nodes[2][inner] + 0.1).max() < 0.03
    step = truth[::4, ::4] + 8 * (np.arange(0, 48, 4) >= 30)
    assert np.abs(nodes[0] - step)[inner].max() < 0.1


def test_other_colours_do_not_bend_a_plane():
    values = slanted(across=0.0, down=0.0)
    values[:, 24:] += 0.9  # too near to be left out for its distance alone
    guide = np.zeros((*values.shape, 3), np.uint8)
    guide[:, 24:] = 90
    alike = np.exp(np.arange(766) / -30.0).astype(np.float32)
    assert np.abs(fitted(values, guide=guide, alike=alike)[0, :, 5] - 20).max() < 0.01
    assert np.abs(fitted(values)[0, :, 5] - 20).max() > 0.1


def test_a_single_disparity_is_level_and_steep_slopes_are_not_believed():
    lone = np.full((17, 17), np.nan, np.float32)
    lone[8, 8] = 5.0
    nodes = fitted(lone)
    np.testing.assert_array_equal(nodes[:, 2, 2], [5, 0, 0])
    assert np.isnan(nodes[0]).sum() == nodes[0].size - 1
    y, x = np.mgrid[:17, :17]
    steep = (3.0 * x + 0 * y).astype(np.float32)
    assert np.abs(fitted(steep)[1:]).max() <= planes.STEEPEST


@pytest.mark.parametrize("own", [False, True])
def test_pixels_take_the_plane_of_their_node(own):
    truth = slanted(21, 30)
    nodes = fitted(truth)
    values = truth + np.float32(0.5)
    values[3, 4] = np.nan
    spread = np.full((3, 21, 30), -7, np.float32)
    planes.spread_nodes(nodes, values, own, 0, 21, spread)
    expected = truth + 0.5 * own
    kept = np.isfinite(values) | (not own)
    np.testing.assert_allclose(spread[0][kept], expected[kept], atol=0.02)
    if own:
        np.testing.assert_array_equal(spread[:, 3, 4], -7)


def path_costs(planes_at, costs, grey, step):
    """Costs of one path, (H, W, K), that comes from ``(row, column)`` away, by plain loops."""
    height, width = costs.shape[:2]
    found = costs.copy()
    dy, dx = step
    for y in range(height)[:: 1 if dy >= 0 else -1]:
        for x in range(width)[:: 1 if dx >= 0 else -1]:
            v, u = y - dy, x - dx
            if not (0 <= v < height and 0 <= u < width):
                continue
            apart = abs(int(grey[y, x]) - int(grey[v, u]))
            most = CHANGES.most_at_edge if apart > CHANGES.edge else CHANGES.most
            value, across, down = planes_at[:, y, x]
            other, other_across, other_down = planes_at[:, v, u, :, None]
            gap = abs(other + other_across * dx + other_down * dy - value)
            gap += abs(other - (value - across * dx - down * dy))
            changes = found[v, u, :, None] + np.minimum(CHANGES.per_px * gap / 2, most)
            found[y, x] += changes.min(axis=0) - found[v, u].min()
    return found


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 6), st.integers(1, 2))
def test_the_search_equals_plain_loops(seed, height, width, vectors):
    rng, count = np.random.default_rng(seed), vectors * WIDE
    sources = rng.uniform(-2, 7, (2, 3, height, width)).astype(np.float32)
    sources[:, 1:] = rng.uniform(-0.5, 0.5, sources[:, 1:].shape)
    table = np.stack([rng.integers(0, 2, count), *rng.integers(-3, 4, (2, count))], axis=1).astype(
        np.int32
    )
    volume = rng.integers(0, 200, (height, 6, width + 3), dtype=np.uint8)
    grey = rng.integers(0, 40, (height, width), dtype=np.uint8)
    sums = np.empty((2, height, width, count), np.float32)
    for upwards in (False, True):
        planes.sweep(sources, table, volume, grey, CHANGES, upwards, sums[int(upwards)])
    at = np.empty((3, height, width, count))
    costs = np.empty((height, width, count))
    for y, x, k in np.ndindex(height, width, count):
        source, dx, dy = table[k]
        u, v = np.clip(x + dx, 0, width - 1), np.clip(y + dy, 0, height - 1)
        value, across, down = sources[source, :, v, u].astype(np.float64)
        value += across * (x - u) + down * (y - v)
        at[:, y, x, k] = value, across, down
        inside = 0 <= value + 1 < 5 and x >= value
        grid = np.arange(6) - 1
        costs[y, x, k] = np.interp(value, grid, volume[y, :, x]) if inside else CHANGES.outside
    steps = {(1, 0): 2, (1, 1): 1, (1, -1): 1, (0, 1): 4}
    for upwards, way in ((0, 1), (1, -1)):
        expected = sum(
            weight * path_costs(at, costs, grey, (way * dy, way * dx))
            for (dy, dx), weight in steps.items()
        )
        np.testing.assert_allclose(sums[upwards], expected, rtol=2e-4, atol=2e-2)
    chosen = np.empty((3, height, width), np.float32)
    planes.choose_planes(sums[0], sums[1], sources, table, 0, height, chosen)
    best = sums.sum(axis=0).argmin(axis=2)
    expected = np.take_along_axis(at, best[None, ..., None], axis=3)[..., 0]
    np.testing.assert_allclose(chosen, expected, atol=1e-4)


def test_what_a_nearer_surface_covers_in_the_right_view_is_hidden():
    values = np.full((1, 40), 4.0, np.float32)
    values[0, 20:30] = 12.0
    hidden = np.empty((1, 40), np.bool_)
    planes.mark_hidden(values, 1.0, 0, 1, hidden)
    # The near surface is seen at right columns 8 to 17, which are 12 to 21 of the far one.
    np.testing.assert_array_equal(np.flatnonzero(hidden[0]), np.arange(12, 20))
