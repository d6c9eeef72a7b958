"""Which cells a surface crosses: the reference, and walls whose place is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.kernels import voxels
from recon.map.kernels import facets
from tests.map.kernels.reference import crossed_cells_reference


def _summed(xyz: np.ndarray, weights: np.ndarray) -> voxels.VoxelSums:
    points = voxels.VoxelPoints(
        xyz, weights.astype(np.float32), np.zeros((len(xyz), 0), np.float32)
    )
    return voxels.add_points(voxels.make_sums(1, 0), points, 1.0, 0)


def _crossed(cells: np.ndarray, xyz: np.ndarray, weights: np.ndarray) -> np.ndarray:
    total = _summed(xyz, weights)
    used = int(total.used[0])
    return facets.crossed_cells(cells.astype(np.int32), total.keys[:used], total.sums[:used])


def _block(edge: int) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(-edge, edge)] * 3, indexing="ij"), -1).reshape(-1, 3)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_the_kernel_finds_what_the_reference_finds(seed: int, number: int) -> None:
    rng = np.random.default_rng(seed)
    xyz, weights = rng.normal(0, 1.5, (number, 3)), rng.uniform(0.1, 50, number)
    total = _summed(xyz, weights)
    used = int(total.used[0])
    cells, sums = voxels.unpack_keys(total.keys[:used]), total.sums[:used].astype(np.float64)
    means = cells + 0.5 + sums[:, 1:] / sums[:, :1]
    points = {
        (i, j, k): (float(weight), mean)
        for (i, j, k), weight, mean in zip(cells.tolist(), sums[:, 0], means, strict=True)
    }
    block = _block(3)
    expected = crossed_cells_reference([(i, j, k) for i, j, k in block.tolist()], points)
    np.testing.assert_array_equal(_crossed(block, xyz, weights), expected)


@pytest.mark.parametrize("slope", [0.0, 0.3, 0.9])
def test_a_plane_crosses_the_cells_that_it_passes_through(slope: float) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-4, 4, (2, 8000))
    xyz = np.stack([x, y, 0.37 + slope * x + 0.1 * y], axis=1)
    block = _block(3)
    normal = np.array([slope, 0.1, -1.0])
    # The corner of a cube that is nearest to a plane is half of the normal's sum of parts away.
    beyond = np.abs((block + 0.5) @ normal + 0.37) - 0.5 * np.abs(normal).sum()
    found = _crossed(block, xyz, np.ones(len(xyz)))
    hit = np.isin(voxels.pack_keys(block), _summed(xyz, np.ones(len(xyz))).keys)
    assert found[hit].all()
    assert (beyond[found] < 1e-5).all()


def test_scattered_points_are_gathered_into_the_layer_of_their_mean() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-4, 4, (2, 8000))
    xyz = np.stack([x, y, 0.5 + rng.normal(0, 0.7, 8000)], axis=1)
    block = _block(3)
    hit = np.isin(voxels.pack_keys(block), _summed(xyz, np.ones(len(xyz))).keys)
    found = _crossed(block, xyz, np.ones(len(xyz))) & hit
    assert len(np.unique(block[hit, 2])) >= 5
    assert (found == (block[:, 2] == 0)).all()


def test_precise_points_overrule_many_uncertain_ones() -> None:
    rng = np.random.default_rng(2)
    x, y = np.tile(rng.uniform(-2, 2, (2, 1000)), 2)
    xyz = np.stack([x, y, np.repeat([1.5, 0.5], 1000)], axis=1)
    block = np.array([[0, 0, 0], [0, 0, 1]])
    weights = np.repeat([1.0, 25.0], 1000)
    assert _crossed(block, xyz, weights).tolist() == [True, False]
    assert _crossed(block, xyz, weights[::-1]).tolist() == [False, True]


def test_a_lone_point_crosses_its_own_cell_alone() -> None:
    xyz = np.array([[0.9, 0.5, 0.5]])
    assert _crossed(_block(2), xyz, np.ones(1)).sum() == 1
    assert _crossed(np.zeros((1, 3)), xyz, np.ones(1)).tolist() == [True]
    assert not _crossed(_block(2), np.zeros((0, 3)), np.zeros(0)).any()
