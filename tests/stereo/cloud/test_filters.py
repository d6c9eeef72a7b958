"""Filters remove planted outliers, keep the surface, and keep attributes with their points."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.values import PointCloud
from recon.stereo.cloud.filters import ANY_SCALE, FilterSettings, filter_cloud, voxel_downsample

OFF = FilterSettings()


def wall_with_outliers() -> tuple[PointCloud, np.ndarray]:
    """A wall of 4 m × 3 m at 5 m, 4 cm between points, and 60 points far in front of it."""
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(np.arange(-2, 2, 0.04), np.arange(-1.5, 1.5, 0.04))
    wall = np.stack([x.ravel(), y.ravel(), 5 + 0.005 * rng.standard_normal(x.size)], axis=1)
    outliers = rng.uniform([-2, -1.5, 1.0], [2, 1.5, 4.0], (60, 3))
    xyz = np.concatenate([wall, outliers]).astype(np.float32)
    return PointCloud(xyz), np.arange(len(xyz)) < len(wall)


@pytest.mark.parametrize(
    "settings",
    [
        OFF.model_copy(update={"radius_m": 0.15}),
        OFF.model_copy(update={"statistical_neighbours": 20}),
        ANY_SCALE,
    ],
)
def test_planted_outliers_go_and_the_planted_surface_stays(settings: FilterSettings) -> None:
    cloud, on_wall = wall_with_outliers()
    kept = filter_cloud(cloud, settings)
    near_wall = kept.xyz[:, 2] > 4.9
    assert near_wall.sum() >= 0.99 * on_wall.sum()
    assert (~near_wall).sum() <= 0.05 * (~on_wall).sum()


def test_everything_off_returns_the_cloud_itself() -> None:
    cloud, _ = wall_with_outliers()
    assert filter_cloud(cloud, OFF) is cloud


def test_a_voxel_averages_every_attribute() -> None:
    cloud = PointCloud(
        xyz=np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [5, 5, 5]], dtype=np.float32),
        rgb=np.array([[10, 20, 30], [20, 40, 60], [1, 2, 3]], dtype=np.uint8),
        normals=np.array([[1, 0, 0], [0, 1, 0], [0, 0, -1]], dtype=np.float32),
        sigma_m=np.array([0.1, 0.3, 0.5], dtype=np.float32),
        confidence=np.array([0.5, 1.0, 0.25], dtype=np.float32),
        weight=np.array([1, 3, 7], dtype=np.float32),
        count=np.array([2, 4, 9], dtype=np.int32),
        frame="world",
    )
    thin = voxel_downsample(cloud, 1.0)
    thin = thin.select(np.argsort(thin.xyz[:, 0]))
    np.testing.assert_allclose(thin.xyz, [[0.2, 0.1, 0.1], [5, 5, 5]], rtol=1e-6)
    np.testing.assert_array_equal(thin.rgb, [[15, 30, 45], [1, 2, 3]])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(thin.normals, [[half, half, 0], [0, 0, -1]], atol=1e-6)
    np.testing.assert_allclose(thin.sigma_m, [0.2, 0.5], rtol=1e-6)
    np.testing.assert_allclose(thin.confidence, [0.75, 0.25], rtol=1e-6)
    np.testing.assert_allclose(thin.weight, [2, 7], rtol=1e-6)
    np.testing.assert_array_equal(thin.count, [3, 9])
    assert thin.frame == "world"


def test_voxels_leave_at_most_one_point_per_cell_and_lose_no_region() -> None:
    cloud, _ = wall_with_outliers()
    thin = filter_cloud(cloud, OFF.model_copy(update={"voxel_m": 0.2}))
    assert 300 < len(thin) < 900  # 20 × 15 cells in the plane of the wall, its edges and outliers
    distance = np.linalg.norm(cloud.xyz[::50, None] - thin.xyz[None], axis=2).min(axis=1)
    assert distance.max() <= 0.2 * np.sqrt(3)


def test_the_same_cloud_gives_the_same_result() -> None:
    cloud, _ = wall_with_outliers()
    settings = FilterSettings(voxel_m=0.1, radius_m=0.3)
    first, second = filter_cloud(cloud, settings), filter_cloud(cloud, settings)
    np.testing.assert_array_equal(first.xyz, second.xyz)


@pytest.mark.parametrize("points", [0, 1, 2])
def test_clouds_of_almost_nothing_pass(points: int) -> None:
    cloud = PointCloud(np.zeros((points, 3), dtype=np.float32))
    settings = FilterSettings(statistical_neighbours=20, radius_m=0.3)
    assert len(filter_cloud(cloud, settings)) <= points


def test_a_voxel_too_small_for_the_cloud_is_refused() -> None:
    cloud = PointCloud(np.array([[0, 0, 0], [1e6, 0, 0]], dtype=np.float32))
    with pytest.raises(SettingsError, match="voxel is too small"):
        filter_cloud(cloud, FilterSettings(voxel_m=1e-5))
