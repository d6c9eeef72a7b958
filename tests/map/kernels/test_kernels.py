"""Rays, chained parts and crossed cells agree with the references, and with what they are."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.kernels import voxels
from recon.map.kernels import clamped, facets, raycast
from tests.map.kernels.reference import (
    Cell,
    apply_evidence_reference,
    cast_rays_reference,
    cells_of,
    is_crossed,
    limit_points_reference,
    log_odds_of,
    measure_points_reference,
    move_reference,
)

LOWEST, HIGHEST = -2.0, 3.5
SEEDS = st.integers(0, 2**32 - 1)
Frame = dict[Cell, float]


def _rays(end: list[float], times: int = 1, **changed: float) -> raycast.Rays:
    """Rays from the centre of cell 0 to one end."""
    origin, ends = np.full(3, 0.5), np.array([end] * times)
    length = np.linalg.norm(ends - origin, axis=1)
    values = {"free": length, "sigma": 0.0, "hit": np.float32(0.8), "miss": np.float32(-0.4)}
    full = {
        k: np.full(times, v, np.asarray(values[k]).dtype) for k, v in (values | changed).items()
    }
    return raycast.Rays(origin, ends, **full)


class _Map:
    """The kernels with the smallest stores, so that every test also tests growth."""

    def __init__(self) -> None:
        self.blocks, self.evidence = clamped.make_clamped(1), raycast.make_blocks(1)

    def cast(self, rays: raycast.Rays, spread: float = 1.0) -> Frame:
        self.evidence = raycast.cast_rays(self.evidence, rays, spread)
        self.blocks = clamped.add_evidence(self.blocks, self.evidence, LOWEST, HIGHEST)
        return log_odds_of(self.blocks)


@settings(max_examples=60)
@given(seed=SEEDS, n=st.integers(0, 12), spread=st.sampled_from([0.0, 1.0, 2.5]))
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
        cells = store.cast(rays, spread)
        apply_evidence_reference(expected, cast_rays_reference(rays, spread), LOWEST, HIGHEST)
    # float32 against float64: three gains below 1 and their sums below 3, 2^-24 of each.
    assert cells == pytest.approx(expected, abs=1e-6)


@settings(max_examples=40)
@given(seed=SEEDS, n=st.integers(0, 20), margin=st.floats(0, 3))
def test_measured_points_equal_those_of_the_reference(seed: int, n: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    T = make_transform(5.0 * np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(0, 100, 3))
    xyz = rng.normal(0, 8, (n, 3)).astype(np.float32)
    measured = (xyz, *rng.uniform(0, 1, (2, n)).astype(np.float32))
    found = raycast.measure_points(*measured, T, 40.0, margin)
    exactly = (part.astype(np.float64) for part in measured)
    expected = measure_points_reference(*exactly, T, 40.0, margin)
    for ours, theirs in zip(found, expected, strict=True):
        # float64 (terms up to 1000, ten operations: 1e-12), rounded to float32 at the end; without
        # the compiler numpy does three operations of the free length (up to 100) in float32.
        atol = 3 * 100 * 2.0**-24 if numba.config.DISABLE_JIT else 1e-11
        np.testing.assert_allclose(ours, theirs, rtol=2.0**-23, atol=atol)


@settings(max_examples=40)
@given(seed=SEEDS, n=st.integers(0, 20), margin=st.sampled_from([0.0, 0.5, 2]))
def test_limited_points_equal_those_of_the_reference(seed: int, n: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    xyz = (rng.normal(0, 8, (n, 3)) * rng.choice([1, 10], (n, 1))).astype(np.float32)
    sigma = rng.uniform(0, 4, n).astype(np.float32)
    before = xyz.copy(), sigma.copy()
    found = raycast.limit_points(xyz, sigma, 12.0, 12.2, margin)
    expected = limit_points_reference(xyz.astype(float), sigma.astype(float), 12.0, 12.2, margin)
    for ours, theirs in zip(found, expected, strict=True):
        # float64 (terms up to 100, ten operations: 1e-13), rounded to float32 at the end.
        np.testing.assert_allclose(ours, theirs, rtol=2.0**-23, atol=1e-12)
    np.testing.assert_equal(before, (xyz, sigma))  # the given points stay


def test_a_ray_frees_exactly_the_cells_that_it_crosses_and_hits_that_of_its_end() -> None:
    assert _Map().cast(_rays([9.5, 0.5, 0.5], hit=0.0)) == pytest.approx(
        {(i, 0, 0): -0.4 for i in range(9)}
    )
    assert _Map().cast(_rays([0.5, 0.5, 0.5])) == {}
    uncertain = _Map().cast(_rays([20.5, 0.5, 0.5], free=12.2, sigma=2.0))
    assert max(cell[0] for cell, value in uncertain.items() if value < 0) == 11
    exact = _Map().cast(_rays([0.5, -6.3, 0.5]))
    assert exact == pytest.approx({(0, -7, 0): 0.8} | {(0, -n, 0): -0.4 for n in range(7)})
    assert exact == _Map().cast(_rays([0.5, -6.3, 0.5], times=50))


def test_a_hit_is_shared_along_the_ray_by_the_normal_distribution() -> None:
    cells = _Map().cast(_rays([20.5, 0.5, 0.5], free=14.0, sigma=2.0), spread=2.0)
    hits = {cell[0]: value for cell, value in cells.items() if value > 0}
    assert sorted(hits) == list(range(16, 25))
    assert hits[20] == pytest.approx(0.8 * math.erf(0.25 / math.sqrt(2)), rel=1e-5)
    assert hits[19] == pytest.approx(hits[21], rel=1e-4)
    # Two standard deviations to each side, rounded up to whole cells.
    assert 0.954 * 0.8 < sum(hits.values()) < 0.8


def _drive(frames: list[Frame]) -> clamped.ClampedBlocks:
    blocks, evidence = clamped.make_clamped(1), raycast.make_blocks(64)
    for frame in frames:
        for cell, change in frame.items():
            key = raycast.block_key(*cell)
            row = voxels.find_or_append(evidence.table, evidence.keys, evidence.used, key)
            evidence.values[row, raycast.cell_in_block(*cell)] = change
        blocks = clamped.add_evidence(blocks, evidence, LOWEST, HIGHEST)
    return blocks


def _random_frames(seed: int, number: int) -> list[Frame]:
    rng = np.random.default_rng(seed)
    # Few cells, so that most are seen often and reach their clamps; some in other blocks.
    places, changes = rng.integers(-12, 12, (6, 3)), np.float32([-1.5, -0.5, 0.8, 1.9])
    return [
        {tuple(p): float(rng.choice(changes)) for p in places[rng.random(6) < 0.7].tolist()}
        for _ in range(number)
    ]


@settings(max_examples=60)
@given(seed=SEEDS, cut=st.integers(0, 20), again=st.integers(0, 20))
def test_parts_in_a_row_equal_one_drive(seed: int, cut: int, again: int) -> None:
    frames, total = _random_frames(seed, 20), clamped.make_clamped(1)
    first, last = sorted((cut, again))
    for part in (frames[:first], frames[first:last], frames[last:]):
        total = clamped.chain_rows(total, clamped.observed_rows(_drive(part)))
    expected: Frame = {}
    for frame in frames:
        apply_evidence_reference(expected, frame, LOWEST, HIGHEST)
    # float32 against float64: the sum of 20 changes of 1.9 at most, each partial sum rounded, which
    # is 2^-24 · 1.9 · (1 + … + 20) = 2.4e-5, and a sum of parts with one of its own.
    assert log_odds_of(total) == pytest.approx(expected, abs=3e-5)


@settings(max_examples=5 if numba.config.DISABLE_JIT else 30)
@given(seed=SEEDS)
def test_moved_cells_equal_those_of_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    blocks = _drive(_random_frames(seed, 5))
    T = make_transform(exp_so3(rng.normal(0, 0.5, 3)), rng.normal(0, 20, 3))
    assert cells_of(clamped.move_blocks(blocks, T)) == move_reference(cells_of(blocks), T)


def test_a_turned_wall_has_no_holes() -> None:
    blocks = _drive([{(i, 0, k): 1.0 for i in range(-20, 20) for k in range(-20, 20)}])
    T = make_transform(exp_so3(np.array([0.0, 0.0, 0.1])), np.zeros(3))
    moved = {(i, k) for i, _, k in cells_of(clamped.move_blocks(blocks, T))}
    # Every column across the wall has it, at all heights.
    assert moved >= {(i, k) for i in range(-18, 18) for k in range(-20, 20)}


BLOCK = np.stack(np.meshgrid(*[np.arange(-3, 3)] * 3, indexing="ij"), -1).reshape(-1, 3)


def _summed(xyz: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    nothing = np.zeros((len(xyz), 0), np.float32)
    points = voxels.VoxelPoints(xyz, weights.astype(np.float32), nothing)
    total = voxels.add_points(voxels.make_sums(1, 0), points, 1.0, 0)
    used = int(total.used[0])
    return total.keys[:used], total.sums[:used]


def _crossed(cells: np.ndarray, xyz: np.ndarray, weights: np.ndarray | float = 1.0) -> np.ndarray:
    summed = _summed(xyz, np.broadcast_to(weights, len(xyz)))
    return facets.crossed_cells(cells.astype(np.int32), *summed)


@settings(max_examples=20)
@given(SEEDS, st.integers(0, 60))
def test_crossed_cells_are_those_of_the_reference(seed: int, number: int) -> None:
    rng = np.random.default_rng(seed)
    xyz, weights = rng.normal(0, 1.5, (number, 3)), rng.uniform(0.1, 50, number)
    keys, sums = _summed(xyz, weights)
    cells, sums = voxels.unpack_keys(keys), sums.astype(np.float64)
    means = cells + 0.5 + sums[:, 1:] / sums[:, :1]
    held = zip(sums[:, 0].tolist(), means, strict=True)
    points = dict(zip(map(tuple, cells.tolist()), held, strict=True))
    expected = [is_crossed(tuple(cell), points) for cell in BLOCK.tolist()]
    np.testing.assert_array_equal(_crossed(BLOCK, xyz, weights), expected)


@pytest.mark.parametrize("slope", [0.0, 0.3, 0.9])
def test_a_plane_crosses_the_cells_that_it_passes_through(slope: float) -> None:
    x, y = np.random.default_rng(0).uniform(-4, 4, (2, 8000))
    xyz = np.stack([x, y, 0.37 + slope * x + 0.1 * y], axis=1)
    normal = np.array([slope, 0.1, -1.0])
    # The corner of a cube that is nearest to a plane is half of the normal's sum of parts away.
    beyond = np.abs((BLOCK + 0.5) @ normal + 0.37) - 0.5 * np.abs(normal).sum()
    found, hit = _crossed(BLOCK, xyz), np.isin(voxels.pack_keys(BLOCK), _summed(xyz, x * 0 + 1)[0])
    assert found[hit].all()
    assert (beyond[found] < 1e-5).all()


def test_scattered_points_are_gathered_into_the_layer_of_their_mean() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-4, 4, (2, 8000))
    xyz = np.stack([x, y, 0.5 + rng.normal(0, 0.7, 8000)], axis=1)
    hit = np.isin(voxels.pack_keys(BLOCK), _summed(xyz, x * 0 + 1)[0])
    assert len(np.unique(BLOCK[hit, 2])) >= 5
    assert ((_crossed(BLOCK, xyz) & hit) == (BLOCK[:, 2] == 0)).all()


def test_precise_points_overrule_many_uncertain_ones_and_a_lone_one_crosses_its_own_cell() -> None:
    x, y = np.tile(np.random.default_rng(2).uniform(-2, 2, (2, 1000)), 2)
    xyz = np.stack([x, y, np.repeat([1.5, 0.5], 1000)], axis=1)
    two = np.array([[0, 0, 0], [0, 0, 1]])
    weights = np.repeat([1.0, 25.0], 1000)
    assert _crossed(two, xyz, weights).tolist() == [True, False]
    assert _crossed(two, xyz, weights[::-1]).tolist() == [False, True]
    alone = np.array([[0.9, 0.5, 0.5]])
    assert BLOCK[_crossed(BLOCK, alone)].tolist() == [[0, 0, 0]]
    assert not _crossed(BLOCK, alone[:0]).any()
