"""Filters remove planted outliers, keep the surface, and keep attributes with their points."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import ReconError, SettingsError, ShapeError
from recon.core.values import PointCloud
from recon.stereo.cloud import open3d_clouds
from recon.stereo.cloud.back_project import (
    ANY_SCALE,
    FilterSettings,
    filter_cloud,
    voxel_downsample,
)

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


@pytest.mark.parametrize("points", [0, 1, 2])
def test_clouds_of_almost_nothing_pass(points: int) -> None:
    cloud = PointCloud(np.zeros((points, 3), dtype=np.float32))
    settings = FilterSettings(statistical_neighbours=20, radius_m=0.3)
    assert len(filter_cloud(cloud, settings)) <= points


def test_a_voxel_too_small_for_the_cloud_is_refused() -> None:
    cloud = PointCloud(np.array([[0, 0, 0], [1e6, 0, 0]], dtype=np.float32))
    with pytest.raises(SettingsError, match="voxel is too small"):
        filter_cloud(cloud, FilterSettings(voxel_m=1e-5))


def frozen(xyz: np.ndarray) -> np.ndarray:
    array = np.ascontiguousarray(xyz, dtype=np.float32)
    array.flags.writeable = False
    return array


CLOUD = frozen(np.random.default_rng(5).random((400, 3)))


@pytest.mark.parametrize("width", [0, 1, 3, 4, 7])
def test_attributes_of_any_width_follow_their_points(width: int) -> None:
    # An attribute that is linear in the position is averaged as the position is.
    weights = np.random.default_rng(1).random((3, width))
    xyz, means = open3d_clouds.voxel_downsample(CLOUD, CLOUD @ weights, 0.25)
    assert len(means) == (len(xyz) if width else 0)
    np.testing.assert_allclose(means, (xyz @ weights)[: len(means)], atol=1e-5)


def test_nearest_is_what_a_full_search_finds() -> None:
    query, reference = CLOUD[:50], CLOUD[50:]
    index, distance = open3d_clouds.nearest(query, reference, 3)
    full = np.linalg.norm(query[:, None] - reference[None], axis=2)
    np.testing.assert_array_equal(index, np.argsort(full, axis=1)[:, :3])
    np.testing.assert_allclose(distance, np.sort(full, axis=1)[:, :3], atol=1e-5)


def test_a_point_needs_the_stated_number_of_others_around_it() -> None:
    line = frozen(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]]))
    np.testing.assert_array_equal(
        open3d_clouds.radius_inliers(line, 1, 1.5), [True, True, True, False]
    )
    np.testing.assert_array_equal(
        open3d_clouds.radius_inliers(line, 2, 1.5), [False, True, False, False]
    )


def test_normals_of_a_sphere_agree_with_their_neighbours() -> None:
    directions = np.random.default_rng(2).standard_normal((600, 3))
    xyz = frozen(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    normals = open3d_clouds.estimate_normals(xyz, 15)
    agreed = open3d_clouds.agree_normals(xyz, normals, 15)
    outwards = np.einsum("ij,ij->i", agreed, xyz)
    assert (np.abs(outwards) > 0.9).all()
    assert len(set(np.sign(outwards))) == 1


@pytest.mark.parametrize(
    "call",
    [
        lambda xyz: open3d_clouds.voxel_downsample(xyz, xyz, 0.1),
        lambda xyz: open3d_clouds.estimate_normals(xyz, 5),
        lambda xyz: open3d_clouds.radius_inliers(xyz, 3, 0.1),
        lambda xyz: open3d_clouds.statistical_inliers(xyz, 3, 2.0),
        lambda xyz: open3d_clouds.nearest(xyz, xyz),
    ],
)
def test_points_that_are_not_finite_are_refused(call) -> None:
    with pytest.raises(ShapeError, match="not finite"):
        call(np.full((20, 3), np.nan, dtype=np.float32))


def test_no_foreign_exception_leaks() -> None:
    with pytest.raises(ReconError):
        open3d_clouds.voxel_downsample(frozen(np.eye(3) * 1e9), np.zeros((3, 0)), 1e-9)
    with pytest.raises(ReconError, match="too few points"):
        open3d_clouds.nearest(CLOUD, CLOUD[:2], 3)


def test_points_that_are_too_far_apart_to_search_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"too far apart to be searched \(got .*e\+30 m"):
        open3d_clouds.nearest(CLOUD * np.float32(1e31), CLOUD * np.float32(1e31))
