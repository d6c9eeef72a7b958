"""The stored rays of a frame represent the frame."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.geometry.se3 import make_transform
from recon.core.values import OccupancyVoxels, PointCloud, RayCloud
from recon.map.kernels import raycast
from recon.map.occupancy import builder as occupancy
from recon.map.occupancy.builder import OccupancyBuilder, OccupancySettings, ray_grain, thin_rays

SETTINGS = OccupancySettings(resolution_m=0.2, max_range_m=20.0)
POSE = make_transform(np.eye(3), np.array([0.11, 0.09, 0.1]))  # no ray along an edge of cells


def _wall(seed: int = 0, n: int = 40_000, depth_m: float = 12.0) -> PointCloud:
    """A wall ahead that is measured with noise."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-4, 4, (n, 2))
    sigma = rng.uniform(0.05, 0.3, n)
    xyz = np.column_stack([xy, depth_m + rng.normal(0, sigma)]).astype(np.float32)
    sure = rng.choice([0.0, 0.4, 1.0], n).astype(np.float32)
    return PointCloud(xyz, sigma_m=sigma.astype(np.float32), confidence=sure)


def _map(cloud: PointCloud, settings: OccupancySettings = SETTINGS) -> OccupancyVoxels:
    builder = OccupancyBuilder(settings, np.eye(4))
    builder.integrate(cloud, POSE)
    return builder.voxels()


def _cells(voxels: OccupancyVoxels, which: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(key) for key in voxels.keys[which].tolist()}


def test_there_is_one_ray_for_each_cube_and_it_counts_its_points() -> None:
    cloud = PointCloud(np.float32([[0.02, 0.02, 5.02], [0.06, 0.04, 5.06], [0.32, 0.02, 5.02]]))
    rays = thin_rays(cloud, SETTINGS)
    assert len(rays) == 2
    assert sorted(rays.count.tolist()) == [1, 2]
    ends = rays.cloud().xyz[np.argsort(rays.count)]
    np.testing.assert_allclose(ends, [[0.32, 0.02, 5.02], [0.04, 0.03, 5.04]], atol=rays.unit_m)
    assert rays.unit_m < 0.002


def test_points_without_confidence_are_no_rays() -> None:
    cloud = PointCloud(np.float32([[0, 0, 5], [1, 0, 5]]), confidence=np.float32([0, 0.5]))
    rays = thin_rays(cloud, SETTINGS)
    assert rays.cloud().xyz[:, 0].round(2).tolist() == [1.0]
    assert rays.cloud().confidence == pytest.approx([0.5], abs=0.003)


def test_a_map_of_rays_is_the_map_of_the_points() -> None:
    cloud = _wall()
    points, rays = _map(cloud), _map(thin_rays(cloud, SETTINGS).cloud())
    for kind in (np.greater, np.less):
        ours, theirs = (_cells(v, kind(v.log_odds, 0)) for v in (points, rays))
        assert len(theirs) > 300
        assert len(ours & theirs) / len(ours | theirs) > 0.97
    assert len(thin_rays(cloud, SETTINGS)) < len(cloud) / 2


def test_coarser_voxels_can_be_made_of_them_too() -> None:
    cloud = _wall()
    coarse = SETTINGS.model_copy(update={"resolution_m": 0.5})
    points, rays = _map(cloud, coarse), _map(thin_rays(cloud, SETTINGS).cloud(), coarse)
    ours, theirs = (_cells(v, v.log_odds > 0) for v in (points, rays))
    assert len(ours & theirs) / len(ours | theirs) > 0.97


@pytest.mark.parametrize("depth_m", [20.5, 24.0, 60.0, 3000.0])
@pytest.mark.parametrize("sigma_m", [0.0, 0.5, 4.0])
def test_points_out_of_range_free_what_they_freed_and_hit_nothing(
    depth_m: float, sigma_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(occupancy, "_MIN_POINTS", 1)
    xyz = (np.float32([[0.013, 0.017, 1.0], [0.1, -0.05, 1.0]]) * np.float32(depth_m)).astype("f4")
    cloud = PointCloud(xyz, sigma_m=np.full(2, sigma_m, np.float32))
    points, rays = _map(cloud, SETTINGS), _map(thin_rays(cloud, SETTINGS).cloud(), SETTINGS)
    assert not (rays.log_odds > 0).any()
    ours, theirs = _cells(points, points.log_odds < 0), _cells(rays, rays.log_odds < 0)
    # A thousandth of a radian turns a ray by a cell's edge now and then.
    assert len(ours ^ theirs) <= 0.05 * len(ours) + 1


def test_points_out_of_range_share_their_cubes() -> None:
    far = np.linspace(30, 3000, 50, dtype=np.float32)[:, None] * np.float32([[0.1, 0.0, 1.0]])
    assert len(thin_rays(PointCloud(far), SETTINGS)) == 1


@pytest.mark.parametrize("max_range_m", [5.0, 25.0, 120.0, 1000.0])
def test_the_farthest_point_has_a_place(max_range_m: float) -> None:
    settings = SETTINGS.model_copy(update={"max_range_m": max_range_m})
    corner = np.float32([[1, -1, 1], [-1, 1, 1], [0, 0, 1]]) * np.float32(2 * max_range_m)
    ends = thin_rays(PointCloud(corner), settings).cloud().xyz
    length = np.linalg.norm(ends, axis=1)
    assert (length > max_range_m).all()
    assert (length < max_range_m + 3 * ray_grain(settings).cell_m).all()


def test_the_same_points_give_the_same_bits_and_none_give_none() -> None:
    one, two = thin_rays(_wall(), SETTINGS), thin_rays(_wall(), SETTINGS)
    for name in ("places", "sigma_m", "confidence", "count"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
    assert len(thin_rays(PointCloud(np.zeros((0, 3), np.float32)), SETTINGS)) == 0


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (PointCloud(np.zeros((1, 3), np.float32), frame="world"), "camera axes"),
        (PointCloud(np.full((1, 3), np.nan, np.float32)), "not finite"),
    ],
)
def test_clouds_that_would_spoil_the_map_are_refused(cloud: PointCloud, words: str) -> None:
    with pytest.raises(MappingError, match=words):
        thin_rays(cloud, SETTINGS)


def test_rays_must_be_of_the_same_number() -> None:
    with pytest.raises(Exception, match="sigma_m"):
        RayCloud(
            np.zeros((2, 3), np.int16),
            np.zeros(1, np.float16),
            np.zeros(2, np.uint8),
            np.zeros(2, np.uint8),
            0.01,
        )


def test_limited_points_keep_what_they_free() -> None:
    xyz = np.float32([[3.0, 0.0, 4.0], [30.0, 0.0, 40.0]])
    sigma = np.float32([0.5, 0.5])
    moved, left = raycast.limit_points(xyz, sigma, 20.0, 20.2, 2.0)
    np.testing.assert_array_equal(moved[0], xyz[0])
    assert left[0] == sigma[0]
    assert np.linalg.norm(moved[1]) == pytest.approx(20.2, rel=1e-6)
    assert left[1] == 0  # it frees all up to the range, with or without its 1 m of doubt
