"""Volumes of heaps are known, and as well as they say."""

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.values import PointCloud
from recon.export.volume import volume_between
from recon.map.cut import Rectangle

CELL_M = 0.2
HEAP_M3 = np.pi * 2.0**2 * 1.5 / 3  # a cone, 1.5 m high


def site(seed: int, heap: float = 0.0, sigma_m: float = 0.02, off_m: float = 0.0) -> PointCloud:
    """30 by 20 m of level ground at -1.6 m, perhaps with a cone at (10, 10), and noise."""
    random = np.random.default_rng(seed)
    x, y = (
        axis.ravel() for axis in np.meshgrid(np.arange(0.05, 30, 0.1), np.arange(0.05, 20, 0.1))
    )
    away = np.hypot(x - 10, y - 10)
    z = -1.6 + heap * 1.5 * np.maximum(1 - away / 2, 0) + off_m + random.normal(0, sigma_m, len(x))
    sigma = np.full(len(x), sigma_m, np.float32)
    return PointCloud(np.column_stack([x, y, z]).astype(np.float32), sigma_m=sigma, frame="map")


def test_a_heap_above_a_plane_and_between_two_days_is_a_cone():
    around = Rectangle((7.0, 7.0), (13.0, 13.0))
    plane = volume_between(-1.6, site(1, heap=1.0), CELL_M, around)
    days = volume_between(site(2), site(1, heap=1.0), CELL_M, around)
    for found in (plane, days):
        assert found.net_m3 == pytest.approx(HEAP_M3, abs=4 * found.sigma_m3 + 0.02)
        assert found.fill_m3 == pytest.approx(HEAP_M3, rel=0.02)
        assert found.compared_m2 == pytest.approx(36.0)
        assert found.not_compared_m2 == 0
        assert 0 < found.sigma_m3 < 0.2
    assert plane.common_sigma_m == 0
    dug = volume_between(site(1, heap=1.0), site(2), CELL_M, around)
    assert dug.cut_m3 == pytest.approx(HEAP_M3, rel=0.03)
    assert dug.fill_m3 < 0.1


@pytest.mark.parametrize(("off_m", "heap"), [(0.0, 0.0), (0.03, 0.0), (0.03, 1.0)])
def test_errors_are_as_large_as_they_are_said_to_be(off_m, heap):
    """Points have noise, and a day lies too high or low as a whole."""
    ratios, around = [], Rectangle((5.0, 5.0), (15.0, 15.0))
    offsets = np.random.default_rng(3).normal(0, off_m, 40)
    for seed, off in enumerate(offsets):
        before, after = site(seed), site(1000 + seed, heap, off_m=off)
        found = volume_between(before, after, CELL_M, around)
        ratios.append((found.net_m3 - heap * HEAP_M3) / found.sigma_m3)
    # Of 40 samples, a standard deviation is known to 11 %; a stated bias is that of this sample.
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_cells_that_one_lacks_are_counted_and_left_out():
    before, after = site(1), site(2, heap=1.0)
    hole = after.select(~Rectangle((9.0, 9.0), (11.0, 11.0)).contains(after.xyz))
    found = volume_between(before, hole, CELL_M, Rectangle((7.0, 7.0), (13.0, 13.0)))
    assert found.not_compared_m2 == pytest.approx(4.0)
    assert found.compared_m2 == pytest.approx(32.0)
    assert found.net_m3 < 0.6 * HEAP_M3
    far = Rectangle((50.0, 50.0), (60.0, 60.0))
    with pytest.raises(MappingError, match="no cell"):
        volume_between(before, after, CELL_M, far)
