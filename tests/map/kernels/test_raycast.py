"""Evidence along rays agrees with the reference, and with what a ray is."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.map.kernels import clamped, raycast
from tests.map.kernels.reference import (
    apply_evidence_reference,
    cast_rays_reference,
    limit_points_reference,
    log_odds_of,
    measure_points_reference,
    walk_reference,
)

Cell = tuple[int, int, int]


def _rays(
    origin: list[float],
    ends: list[list[float]],
    *,
    free: float | None = None,
    sigma: float = 0.0,
    hit: float = 0.8,
) -> raycast.Rays:
    points = np.array(ends, np.float64).reshape(-1, 3)
    lengths = np.linalg.norm(points - origin, axis=1)
    n = len(points)
    return raycast.Rays(
        origin=np.array(origin, np.float64),
        ends=points,
        free=lengths if free is None else np.full(n, free),
        sigma=np.full(n, sigma),
        hit=np.full(n, hit, np.float32),
        miss=np.full(n, -0.4, np.float32),
    )


class _Map:
    """The kernel with the smallest stores, so that every test also tests growth."""

    def __init__(self) -> None:
        self.blocks = clamped.make_clamped(1)
        self.evidence = raycast.make_blocks(1)

    def cast(self, rays: raycast.Rays, spread: float) -> None:
        self.evidence = raycast.cast_rays(self.evidence, rays, spread)
        self.blocks = clamped.add_evidence(self.blocks, self.evidence, -2.0, 3.5)


def _cast(rays: raycast.Rays, spread: float = 1.0) -> dict[Cell, float]:
    store = _Map()
    store.cast(rays, spread)
    return log_odds_of(store.blocks)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1), n=st.integers(0, 12), spread=st.sampled_from([0.0, 1.0, 2.5])
)
def test_frames_equal_those_of_the_reference(seed: int, n: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    store, expected = _Map(), {}
    for _ in range(3):
        origin = rng.uniform(-5, 5, 3)
        ends = origin + rng.normal(0, 12, (n, 3)) * rng.integers(0, 2, (n, 3))
        length = np.linalg.norm(ends - origin, axis=1)
        rays = raycast.Rays(
            origin=origin,
            ends=ends,
            free=length * rng.uniform(-0.2, 1.0, n),
            sigma=rng.choice([0.0, 0.3, 3.0], n),
            hit=(rng.choice([0.0, 0.5, 0.85], n)).astype(np.float32),
            miss=(-rng.choice([0.0, 0.2, 0.4], n)).astype(np.float32),
        )
        store.cast(rays, spread)
        evidence = cast_rays_reference(rays, spread)
        apply_evidence_reference(expected, evidence, -2.0, 3.5)
    cells = log_odds_of(store.blocks)
    assert cells.keys() == expected.keys()
    for cell, value in cells.items():
        # float32 against float64: three gains below 1 and their sums below 3, 2^-24 of each.
        assert value == pytest.approx(expected[cell], abs=1e-6)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 20), margin=st.floats(0, 3))
def test_measured_points_equal_those_of_the_reference(seed: int, n: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = 5.0 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, 3] = rng.normal(0, 100, 3)
    xyz = rng.normal(0, 8, (n, 3)).astype(np.float32)
    sigma, confidence = rng.uniform(0, 1, (2, n)).astype(np.float32)
    measured = xyz, sigma, confidence
    found = raycast.measure_points(*measured, T, 40.0, margin)
    exactly = (part.astype(np.float64) for part in measured)
    for ours, theirs in zip(
        found, measure_points_reference(*exactly, T, 40.0, margin), strict=True
    ):
        # float64 (terms up to 1000, ten operations: 1e-12), rounded to float32 at the end; without
        # the compiler numpy does three operations of the free length (up to 100) in float32.
        atol = 3 * 100 * 2.0**-24 if numba.config.DISABLE_JIT else 1e-11
        np.testing.assert_allclose(ours, theirs, rtol=2.0**-23, atol=atol)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 20), margin=st.sampled_from([0.0, 0.5, 2]))
def test_limited_points_equal_those_of_the_reference(seed: int, n: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    xyz = (rng.normal(0, 8, (n, 3)) * rng.choice([1, 10], (n, 1))).astype(np.float32)
    sigma = rng.uniform(0, 4, n).astype(np.float32)
    before = xyz.copy(), sigma.copy()
    ours = raycast.limit_points(xyz, sigma, 12.0, 12.2, margin)
    theirs = limit_points_reference(xyz.astype(float), sigma.astype(float), 12.0, 12.2, margin)
    # float64 (terms up to 100, ten operations: 1e-13), rounded to float32 at the end.
    np.testing.assert_allclose(ours[0], theirs[0], rtol=2.0**-23, atol=1e-12)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=2.0**-23, atol=1e-12)
    np.testing.assert_array_equal(before[0], xyz)  # the given points stay
    np.testing.assert_array_equal(before[1], sigma)


@given(
    origin=st.tuples(*[st.floats(-4, 4)] * 3),
    angles=st.tuples(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5)),
)
def test_walked_cells_touch_and_cover_the_ray(
    origin: tuple[float, float, float], angles: tuple[float, float]
) -> None:
    u = np.array(
        [
            math.cos(angles[1]) * math.cos(angles[0]),
            math.cos(angles[1]) * math.sin(angles[0]),
            math.sin(angles[1]),
        ]
    )
    before = None
    for number, (cell, enter, leave) in enumerate(walk_reference(origin, tuple(u.tolist()))):
        middle = np.array(origin) + u * (enter + leave) / 2
        # 1e-9: rounding of a boundary's length.
        assert (middle >= np.array(cell) - 1e-9).all()
        assert (middle <= np.array(cell) + 1 + 1e-9).all()
        if before is not None:
            assert np.abs(np.subtract(cell, before)).sum() == 1
        before = cell
        if number == 30:
            return


def test_a_ray_through_an_empty_map_frees_exactly_the_cells_that_it_crosses() -> None:
    rays = _rays([0.5, 0.5, 0.5], [[9.5, 0.5, 0.5]], hit=0.0)
    assert _cast(rays) == {(i, 0, 0): pytest.approx(-0.4) for i in range(9)}
    assert _cast(_rays([0.5, 0.5, 0.5], [[0.5, 0.5, 0.5]])) == {}
    uncertain = _rays([0.5, 0.5, 0.5], [[20.5, 0.5, 0.5]], free=12.2, sigma=2.0)
    assert max(cell[0] for cell, value in _cast(uncertain).items() if value < 0) == 11


def test_an_exact_point_hits_its_cell_alone() -> None:
    cells = _cast(_rays([0.5, 0.5, 0.5], [[0.5, -6.3, 0.5]]))
    assert [cell for cell, value in cells.items() if value > 0] == [(0, -7, 0)]
    assert cells[0, -7, 0] == pytest.approx(0.8)
    assert len(cells) == 8
    assert cells == _cast(_rays([0.5, 0.5, 0.5], [[0.5, -6.3, 0.5]] * 50))


def test_a_hit_outweighs_misses_whatever_the_order() -> None:
    ends = [[20.5, 0.5, 0.5], [10.5, 0.5, 0.5], [25.5, 0.5, 0.5]]
    for order in ([0, 1, 2], [1, 0, 2], [2, 0, 1]):
        cells = _cast(_rays([0.5, 0.5, 0.5], [ends[n] for n in order]))
        assert cells[10, 0, 0] == pytest.approx(0.8)
        assert cells[15, 0, 0] == pytest.approx(-0.4)


def test_a_hit_is_shared_along_the_ray_by_the_normal_distribution() -> None:
    cells = _cast(_rays([0.5, 0.5, 0.5], [[20.5, 0.5, 0.5]], free=14.0, sigma=2.0), spread=2.0)
    share = 0.5 * (math.erf(0.5 / 2 / math.sqrt(2)) - math.erf(-0.5 / 2 / math.sqrt(2)))
    assert cells[20, 0, 0] == pytest.approx(0.8 * share, rel=1e-5)
    hits = {cell[0]: value for cell, value in cells.items() if value > 0}
    assert sorted(hits) == list(range(16, 25))
    assert hits[19] == pytest.approx(hits[21], rel=1e-4)
    # Two standard deviations to each side, rounded up to whole cells.
    assert 0.954 * 0.8 < sum(hits.values()) < 0.8
