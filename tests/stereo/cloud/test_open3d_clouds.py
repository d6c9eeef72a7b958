"""The Open3D adapter takes read-only arrays, and returns our arrays and errors."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import ReconError, ShapeError
from recon.stereo.cloud import open3d_clouds


def frozen(xyz: np.ndarray) -> np.ndarray:
    array = np.ascontiguousarray(xyz, dtype=np.float32)
    array.flags.writeable = False
    return array


CLOUD = frozen(np.random.default_rng(5).random((400, 3)))


def test_read_only_arrays_are_taken_and_float32_comes_back() -> None:
    xyz, means = open3d_clouds.voxel_downsample(CLOUD, frozen(CLOUD), 0.2)
    assert (xyz.dtype, means.dtype) == (np.float32, np.float32)
    assert open3d_clouds.estimate_normals(CLOUD, 10).dtype == np.float32
    assert open3d_clouds.statistical_inliers(CLOUD, 10, 2.0).dtype == bool
    assert open3d_clouds.radius_inliers(CLOUD, 3, 0.2).shape == (400,)
    index, distance = open3d_clouds.nearest(CLOUD, CLOUD)
    assert (index.dtype, distance.dtype) == (np.int32, np.float32)


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
