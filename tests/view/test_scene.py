"""Which points are shown of many, and which one a click hits."""

import numpy as np

from recon.core.values import PointCloud
from recon.report.scene import Points
from recon.view.server import cut, halvings, pick


def spread(x_m: float, count: int = 1000) -> Points:
    """Points in a cube of a metre."""
    xyz = np.random.default_rng(0).random((count, 3), np.float32) + np.float32((x_m, 0, 0))
    return Points(f"{x_m}", PointCloud(xyz, rgb=np.zeros((count, 3), np.uint8), frame="map"))


def test_tiles_share_no_point_and_are_256_points_wide():
    tiles = cut(join(spread(0.0), spread(30.0)), 0.1)
    assert sorted(len(tile.cloud) for tile in tiles) == [1000, 1000]
    assert len({tile.name for tile in tiles}) == 2


def join(*parts: Points) -> PointCloud:
    return PointCloud(np.concatenate([part.cloud.xyz for part in parts]), frame="map")


def test_far_points_are_thinned_first_until_the_limit_is_kept():
    parts = [spread(x_m) for x_m in (1.0, 10.0, 100.0)]
    assert halvings(parts, np.zeros(3), 3000) == [0, 0, 0]
    for limit in (2000, 1500, 500, 100, 10):
        times = halvings(parts, np.zeros(3), limit)
        assert times == sorted(times)
        kept = sum(len(part.cloud.xyz[:: 1 << n]) for part, n in zip(parts, times, strict=True))
        assert kept <= limit


def test_a_click_finds_the_nearest_point_on_its_ray_or_none():
    parts = [spread(5.0), spread(50.0)]
    for part, number in ((parts[0], 7), (parts[1], 7)):
        aim = part.cloud.xyz[number].astype(np.float64)
        hit = pick([part], np.zeros(3), aim / np.linalg.norm(aim))
        assert np.linalg.norm(np.cross(hit, aim)) / np.linalg.norm(aim) < 0.006 * 51
        assert np.linalg.norm(hit) <= np.linalg.norm(aim) + 1e-6
    assert pick(parts, np.zeros(3), np.array([-1.0, 0.0, 0.0])) is None
