"""What single frames saw of some cells agrees with the references."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.map.kernels import raycast
from recon.map.kernels.observations import count_observation, rays_towards
from tests.map.kernels import reference

SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=40)
@given(seed=SEEDS, points=st.integers(0, 40), cells=st.integers(0, 6))
def test_rays_towards_cells_are_those_of_the_reference(seed, points, cells):
    rng = np.random.default_rng(seed)
    # Places on a grid of sixteenths, which float32 has exactly: none rounds into another bin.
    xyz = (rng.integers(-40, 41, (points, 3)) / 16).astype(np.float32)
    centres = rng.integers(-40, 41, (cells, 3)) / 16
    found = rays_towards(xyz, centres, 0.25)
    np.testing.assert_array_equal(found, reference.rays_towards_reference(xyz, centres, 0.25))


@settings(max_examples=40)
@given(seed=SEEDS, spread=st.sampled_from([0.0, 0.7]))
def test_no_ray_that_says_something_of_a_cell_is_left_out(seed, spread):
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-12, 12, (30, 3)).astype(np.float32)
    cells = np.array([rng.integers(-6, 6, 3)])
    length = np.linalg.norm(ends.astype(float), axis=1)
    rays = raycast.Rays(
        origin=np.zeros(3),
        ends=ends.astype(float),
        free=length,
        sigma=np.zeros(30),
        hit=np.full(30, 0.8, np.float32),
        miss=np.full(30, -0.4, np.float32),
    )
    ahead = ends[:, 2] > 0  # a camera has none behind it
    chosen = rays_towards(ends, cells + 0.5, 1.0)
    among, alone = (
        reference.cast_rays_reference(
            rays._replace(**{n: getattr(rays, n)[which] for n in rays._fields[1:]}), spread
        )
        for which in (ahead, chosen)
    )
    cell = tuple(cells[0].tolist())
    if cell[2] >= 0:
        assert alone.get(cell) == among.get(cell)


@settings(max_examples=40)
@given(seed=SEEDS, spread=st.sampled_from([0.0, 1.0, 2.5]))
def test_rays_into_some_blocks_leave_there_what_they_leave_in_all(seed, spread):
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-5, 5, 3)
    ends = origin + rng.normal(0, 12, (12, 3))
    length = np.linalg.norm(ends - origin, axis=1)
    rays = raycast.Rays(
        origin=origin,
        ends=ends,
        free=length * rng.uniform(0, 1.0, 12),
        sigma=rng.choice([0.0, 0.3, 3.0], 12),
        hit=rng.choice([0.0, 0.5, 0.85], 12).astype(np.float32),
        miss=-rng.choice([0.0, 0.2, 0.4], 12).astype(np.float32),
    )
    everywhere = raycast.cast_rays(raycast.make_blocks(1), rays, spread)
    used = int(everywhere.used[0])
    wanted = rng.permutation(used)[: used // 2]
    # And one that no ray meets.
    blocks = raycast.blocks_of(np.append(everywhere.keys[wanted], np.int64(0)))
    raycast.cast_rays_into(blocks, rays, spread)
    np.testing.assert_array_equal(blocks.values[:-1], everywhere.values[wanted])
    assert not blocks.values[-1].any()


@settings(max_examples=40)
@given(seed=SEEDS, frames=st.integers(0, 8), cells=st.integers(1, 6))
def test_looks_are_counted_as_by_the_reference(seed, frames, cells):
    rng = np.random.default_rng(seed)
    looks = rng.integers(-1, 2, (frames, cells)).astype(np.int8)
    pairs = rng.integers(0, cells, (5, 2))
    of_cells, of_pairs = np.zeros((3, cells), np.int64), np.zeros((2, 5), np.int64)
    before = np.zeros(cells, np.int8)
    for look in looks:
        count_observation(look, before, of_cells, pairs, of_pairs)
    expected = reference.counts_reference(looks, pairs)
    np.testing.assert_array_equal(of_cells, expected[0])
    np.testing.assert_array_equal(of_pairs, expected[1])
