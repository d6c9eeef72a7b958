"""Rays, chained parts and crossed cells agree with the references, and with what they are."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.kernels import voxels
from recon.map.kernels import clamped, facets, raycast
from tests.map.kernels import reference

LOWEST, HIGHEST = -2.0, 3.5
SEEDS = st.integers(0, 2**32 - 1)
Frame = dict[reference.Cell, float]


@settings(max_examples=60)
@given(seed=SEEDS, n=st.integers(0, 12), spread=st.sampled_from([0.0, 1.0, 2.5]))
def test_frames_equal_those_of_the_reference(seed, n, spread):
    rng = np.random.default_rng(seed)
    # The smallest stores, so that they grow.
    blocks, evidence, expected = clamped.make_clamped(1), raycast.make_blocks(1), {}
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
        evidence = raycast.cast_rays(evidence, rays, spread)
        blocks = clamped.add_evidence(blocks, evidence, LOWEST, HIGHEST)
        reference.apply_evidence_reference(
            expected, reference.cast_rays_reference(rays, spread), LOWEST, HIGHEST
        )
    # float32 against float64: three gains below 1 and their sums below 3, 2^-24 of each.
    assert reference.log_odds_of(blocks) == pytest.approx(expected, abs=1e-6)


@settings(max_examples=40)
@given(seed=SEEDS, n=st.integers(0, 20), margin=st.floats(0, 3))
def test_measured_points_equal_those_of_the_reference(seed, n, margin):
    rng = np.random.default_rng(seed)
    T = make_transform(5.0 * np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(0, 100, 3))
    xyz = rng.normal(0, 8, (n, 3)).astype(np.float32)
    measured = (xyz, *rng.uniform(0, 1, (2, n)).astype(np.float32))
    found = raycast.measure_points(*measured, T, 40.0, margin)
    exactly = (part.astype(np.float64) for part in measured)
    expected = reference.measure_points_reference(*exactly, T, 40.0, margin)
    for ours, theirs in zip(found, expected, strict=True):
        # float64 (terms up to 1000, ten operations: 1e-12), rounded to float32 at the end; without
        # the compiler numpy does three operations of the free length (up to 100) in float32.
        atol = 3 * 100 * 2.0**-24 if numba.config.DISABLE_JIT else 1e-11
        np.testing.assert_allclose(ours, theirs, rtol=2.0**-23, atol=atol)


@settings(max_examples=40)
@given(seed=SEEDS, n=st.integers(0, 20), margin=st.sampled_from([0.0, 0.5, 2]))
def test_limited_points_equal_those_of_the_reference(seed, n, margin):
    rng = np.random.default_rng(seed)
    xyz = (rng.normal(0, 8, (n, 3)) * rng.choice([1, 10], (n, 1))).astype(np.float32)
    sigma = rng.uniform(0, 4, n).astype(np.float32)
    before = xyz.copy(), sigma.copy()
    found = raycast.limit_points(xyz, sigma, 12.0, 12.2, margin)
    expected = reference.limit_points_reference(
        xyz.astype(float), sigma.astype(float), 12.0, 12.2, margin
    )
    for ours, theirs in zip(found, expected, strict=True):
        # float64 (terms up to 100, ten operations: 1e-13), rounded to float32 at the end.
        np.testing.assert_allclose(ours, theirs, rtol=2.0**-23, atol=1e-12)
    np.testing.assert_equal(before, (xyz, sigma))  # the given points stay


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
def test_parts_in_a_row_equal_one_drive(seed, cut, again):
    frames, total = _random_frames(seed, 20), clamped.make_clamped(1)
    first, last = sorted((cut, again))
    for part in (frames[:first], frames[first:last], frames[last:]):
        total = clamped.chain_rows(total, clamped.observed_rows(_drive(part)))
    expected: Frame = {}
    for frame in frames:
        reference.apply_evidence_reference(expected, frame, LOWEST, HIGHEST)
    # float32 against float64: the sum of 20 changes of 1.9 at most, each partial sum rounded, which
    # is 2^-24 · 1.9 · (1 + … + 20) = 2.4e-5, and a sum of parts with one of its own.
    assert reference.log_odds_of(total) == pytest.approx(expected, abs=3e-5)


@settings(max_examples=5 if numba.config.DISABLE_JIT else 30)
@given(seed=SEEDS)
def test_moved_cells_equal_those_of_the_reference(seed):
    rng = np.random.default_rng(seed)
    blocks = _drive(_random_frames(seed, 5))
    T = make_transform(exp_so3(rng.normal(0, 0.5, 3)), rng.normal(0, 20, 3))
    assert reference.cells_of(clamped.move_blocks(blocks, T)) == reference.move_reference(
        reference.cells_of(blocks), T
    )


BLOCK = np.stack(np.meshgrid(*[np.arange(-3, 3, dtype=np.int32)] * 3, indexing="ij"), -1)
BLOCK = BLOCK.reshape(-1, 3)


def _summed(xyz: np.ndarray, weights: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, ...]:
    values = variances[:, None].astype(np.float32)
    points = voxels.VoxelPoints(xyz, weights.astype(np.float32), values)
    return voxels.copy_sums(voxels.add_points(voxels.make_sums(1, 1), points, 1.0, 0))


@settings(max_examples=20)
@given(SEEDS, st.integers(0, 60), st.sampled_from([0.1, 1.0, 10.0]))
def test_crossed_cells_are_those_of_the_reference(seed, number, variance):
    rng = np.random.default_rng(seed)
    xyz, weights = rng.normal(0, 3.0, (number, 3)), rng.uniform(0.1, 50, number)
    keys, summed = _summed(xyz, weights, variance * rng.uniform(0.1, 2, number))
    cells, sums = voxels.unpack_keys(keys), summed.astype(np.float64)
    means, variances = cells + 0.5 + sums[:, 1:4] / sums[:, :1], sums[:, 4] / sums[:, 0]
    held = zip(sums[:, 0].tolist(), means, variances.tolist(), strict=True)
    points = dict(zip(map(tuple, cells.tolist()), held, strict=True))
    expected = [reference.is_crossed(tuple(cell), points) for cell in BLOCK.tolist()]
    np.testing.assert_array_equal(facets.crossed_cells(BLOCK, keys, summed), expected)


@pytest.mark.parametrize("sigma", [0.1, 3.0])
@pytest.mark.parametrize("slope", [0.0, 0.3, 0.9])
def test_a_plane_crosses_the_cells_that_it_passes_through(slope, sigma):
    x, y = np.random.default_rng(0).uniform(-4, 4, (2, 8000))
    xyz = np.stack([x, y, 0.37 + slope * x + 0.1 * y], axis=1)
    normal = np.array([slope, 0.1, -1.0])
    # The corner of a cube that is nearest to a plane is half of the normal's sum of parts away.
    beyond = np.abs((BLOCK + 0.5) @ normal + 0.37) - 0.5 * np.abs(normal).sum()
    keys, sums = _summed(xyz, np.ones(8000), np.full(8000, sigma**2))
    found = facets.crossed_cells(BLOCK, keys, sums)
    assert found[np.isin(voxels.pack_keys(BLOCK), keys)].all()
    assert (beyond[found] < 1e-5).all()
