from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, PointCloud, TriangleMesh
from recon.report.scene import quantise_colours
from recon.report.thin import thin_cloud, thin_grid, thin_mesh


@given(count=st.integers(0, 400), limit=st.integers(1, 100), seed=st.integers(0, 99))
def test_thinned_cloud_is_a_part_of_the_cloud_within_the_limit(
    count: int, limit: int, seed: int
) -> None:
    xyz = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    thinned = thin_cloud(PointCloud(xyz), limit).xyz
    assert len(thinned) == count if count <= limit else 0 < len(thinned) <= limit
    assert {tuple(p) for p in thinned.tolist()} <= {tuple(p) for p in xyz.tolist()}


def test_cloud_of_one_place_is_thinned_to_one_point() -> None:
    assert len(thin_cloud(PointCloud(np.ones((50, 3), dtype=np.float32)), 10)) == 1


def test_thinned_cloud_keeps_its_extent_and_most_of_what_it_may(cloud: PointCloud) -> None:
    thinned = thin_cloud(cloud, 500)
    # A cell may not be much larger than needed, or detail would be lost for nothing.
    assert 250 <= len(thinned) <= 500
    assert np.ptp(thinned.xyz, axis=0) == pytest.approx(np.ptp(cloud.xyz, axis=0), abs=1.0)
    assert thinned.rgb is not None


def test_thinning_is_deterministic(cloud: PointCloud) -> None:
    np.testing.assert_array_equal(thin_cloud(cloud, 300).xyz, thin_cloud(cloud, 300).xyz)


def test_thinned_mesh_covers_the_same_place_with_fewer_triangles(mesh: TriangleMesh) -> None:
    thinned = thin_mesh(mesh, 200)
    assert 20 < len(thinned.faces) <= 200
    assert thinned.faces.max() < len(thinned.vertices)
    # The sheet is 19 m wide; cells of a few metres move its border by less than one cell.
    assert np.ptp(thinned.vertices, axis=0)[:2] == pytest.approx([19, 19], abs=4)
    assert thinned.rgb is not None
    assert len(thinned.rgb) == len(thinned.vertices)


def test_small_mesh_stays_as_it_is(mesh: TriangleMesh) -> None:
    assert thin_mesh(mesh, 10_000) is mesh


def test_up_to_256_greys_are_kept_within_one_level() -> None:
    grey = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    palette, index = quantise_colours(grey)
    assert np.abs(palette[index].astype(int) - grey).max() <= 1


@given(count=st.integers(0, 300), seed=st.integers(0, 99))
def test_palette_is_small_and_every_colour_is_near_its_entry(count: int, seed: int) -> None:
    rgb = np.random.default_rng(seed).integers(0, 256, (count, 3), dtype=np.uint8)
    palette, index = quantise_colours(rgb)
    assert 1 <= len(palette) <= 256
    assert len(index) == count
    if count:
        # 300 random colours in 256 entries: few share one, and those are close.
        assert np.abs(palette[index].astype(int) - rgb).mean() < 16


def test_two_colours_of_unequal_number_stay_two() -> None:
    rgb = np.array([[0, 0, 0]] * 3 + [[200, 10, 10]] * 97, dtype=np.uint8)
    palette, index = quantise_colours(rgb)
    np.testing.assert_array_equal(palette[index], rgb)


def test_a_thinned_grid_keeps_its_obstacles_and_its_place() -> None:
    cells = np.full((7, 10), UNKNOWN, np.int8)
    cells[:3] = FREE
    cells[1, 9] = cells[6, 0] = OCCUPIED
    thinned = thin_grid(OccupancyGrid(cells, 0.2, (-3.0, 4.0)), 4)
    assert (thinned.resolution_m, thinned.origin_m) == (pytest.approx(0.6), (-3.0, 4.0))
    expected = [[FREE, FREE, FREE, OCCUPIED], [UNKNOWN] * 4, [OCCUPIED, *[UNKNOWN] * 3]]
    np.testing.assert_array_equal(thinned.cells, expected)


def test_a_small_grid_stays_as_it_is() -> None:
    grid = OccupancyGrid(np.zeros((3, 4), np.int8), 0.2, (0.0, 0.0))
    assert thin_grid(grid, 4) is grid
