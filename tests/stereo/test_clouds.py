"""Points are exact, with their errors; those between surfaces and outliers are removed."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import ReconError, SettingsError, ShapeError
from recon.core.values import Disparity, PointCloud, Reason, RectifiedCamera, RectifiedPair
from recon.core.values.camera import project
from recon.stereo import open3d_clouds
from recon.stereo.frame import (
    ANY_SCALE,
    CloudSettings,
    FilterSettings,
    back_project,
    drop_islands,
    filter_cloud,
    remove_flying_edges,
    voxel_downsample,
)

pytestmark = pytest.mark.portable

SHAPE = (40, 64)
CAMERA = RectifiedCamera(100.0, 30.5, 19.0, 34.5, 0.2, SHAPE[1], SHAPE[0])
FB = CAMERA.focal_px * CAMERA.baseline_m
ALL = CloudSettings(min_range_m=0, max_range_m=None, max_relative_sigma=None)
EMPTY = np.full(SHAPE, np.nan)


def as_disparity(values: np.ndarray, sigma_px: float = 0.5) -> Disparity:
    values = values.astype(np.float32)
    known = np.isfinite(values)
    return Disparity(
        values=values,
        confidence=np.where(known, 0.7, 0).astype(np.float32),
        sigma_px=np.where(known, sigma_px, np.nan).astype(np.float32),
        reason=np.where(known, Reason.VALID, Reason.OCCLUDED).astype(np.uint8),
    )


def make_pair(*, colour: bool = False) -> RectifiedPair:
    grey = np.arange(40 * 64, dtype=np.uint16).reshape(SHAPE).astype(np.uint8)
    rgb = np.stack([grey, grey // 2, 255 - grey], axis=2)
    return RectifiedPair(grey, grey, CAMERA, left_rgb=rgb if colour else None)


@given(st.integers(0, 2**16))
def test_points_project_back_to_their_pixels(seed):
    rng = np.random.default_rng(seed)
    values = rng.uniform(1, 40, SHAPE)
    values[rng.random(SHAPE) < 0.3] = np.nan
    cloud = back_project(as_disparity(values), make_pair(), ALL)
    u, v, d = project(cloud.xyz.astype(np.float64), CAMERA)
    rows, columns = np.nonzero(np.isfinite(values))
    # float32 coordinates hold seven digits; pixels go up to 64.
    np.testing.assert_allclose(u, columns, atol=1e-4)
    np.testing.assert_allclose(v, rows, atol=1e-4)
    np.testing.assert_allclose(d, values[rows, columns], atol=1e-4)
    np.testing.assert_allclose(cloud.xyz[:, 2] * (d + CAMERA.doffs_px), FB, rtol=1e-5)


def test_sigma_grows_with_the_square_of_depth_and_is_its_spread_under_noise():
    values = np.full(SHAPE, 6.0)
    values[:, 32:] = 1.0
    cloud = back_project(as_disparity(values, sigma_px=0.25), make_pair(), ALL)
    # f·b / (d + doffs) = 20 / (6 + 4)
    assert sorted(set(cloud.xyz[:, 2].tolist())) == [2, 4]
    np.testing.assert_allclose(cloud.sigma_m, cloud.xyz[:, 2] ** 2 * 0.25 / FB, rtol=1e-5)
    noisy = 16.0 + 0.1 * np.random.default_rng(3).standard_normal(SHAPE)
    cloud = back_project(as_disparity(noisy, sigma_px=0.1), make_pair(), ALL)
    # 2560 samples give the standard deviation within 1.4 %; the first order adds less.
    assert np.std(cloud.xyz[:, 2]) == pytest.approx(float(np.mean(cloud.sigma_m)), rel=0.05)


def test_range_and_sigma_decide_what_is_kept():
    disparity = as_disparity(np.tile(np.linspace(0.5, 36, 64), (40, 1)))

    def kept(**settings: float | None) -> np.ndarray:
        chosen = ALL.model_copy(update=settings)
        return back_project(disparity, make_pair(), chosen).xyz

    z = kept(min_range_m=1.0, max_range_m=3.0)[:, 2]
    assert 1.0 <= z.min() < 1.1
    assert 2.8 < z.max() <= 3.0
    # sigma_z / Z = Z·sigma_d / (f·b) = 0.05 at Z = 2 m.
    assert 1.9 < kept(max_relative_sigma=0.05)[:, 2].max() <= 2.0


def test_points_carry_colours_and_those_beyond_infinity_or_without_source_are_not_made():
    values = EMPTY.copy()
    values[7, 11] = 6.0
    grey, coloured = make_pair(), make_pair(colour=True)
    for pair, colour in ((grey, [grey.left[7, 11]] * 3), (coloured, coloured.left_rgb[7, 11])):
        cloud = back_project(as_disparity(values), pair, ALL)
        np.testing.assert_array_equal(cloud.rgb, [colour])
        assert cloud.normals[0, 2] < -0.99  # that of a lone pixel
    assert back_project(as_disparity(values), grey, ALL, normals=False).normals is None
    values = np.full(SHAPE, -CAMERA.doffs_px)
    values[:, :10] = -CAMERA.doffs_px - 3
    values[:, 60:] = 6.0
    valid = np.ones(SHAPE, dtype=bool)
    valid[:5] = False
    cloud = back_project(as_disparity(values), replace(make_pair(), valid=valid), ALL)
    assert len(cloud) == 35 * 4
    assert np.isfinite(cloud.xyz).all()
    assert len(back_project(as_disparity(EMPTY), make_pair(), ALL)) == 0
    with pytest.raises(ShapeError, match="differ in size"):
        back_project(as_disparity(np.full((40, 63), 6.0)), make_pair(), ALL)


@pytest.mark.parametrize(
    ("normal", "distance_m"),
    [((0, 0, 1.0), 2.0), ((0, 0.98, 0.199), 1.0), ((0.8, 0, 0.6), 1.5), ((-0.5, 0.3, 0.81), 2.0)],
)
def test_normals_of_a_plane_are_exact_and_face_the_camera(normal, distance_m):
    n = np.array(normal) / np.linalg.norm(normal)
    v, u = np.mgrid[:40, :64]
    rays = np.stack([(u - CAMERA.cx_px) / 100, (v - CAMERA.cy_px) / 100, 1.0 + 0 * u], axis=-1)
    values = FB / distance_m * (rays @ n) - CAMERA.doffs_px
    values[values + CAMERA.doffs_px < 0.5] = np.nan
    values[::5, ::7] = np.nan
    cloud = back_project(as_disparity(values), make_pair(), ALL)
    assert (np.einsum("ij,ij->i", cloud.normals, cloud.xyz) < 0).all()
    # Single precision sums over a window of 49 pixels.
    np.testing.assert_allclose(cloud.normals, np.tile(-n, (len(cloud), 1)), atol=2e-3)


@pytest.fixture
def both() -> Disparity:
    """Measured at left, inferred at right, nothing at all in the first row."""
    values = np.tile(np.linspace(8.0, 12.0, SHAPE[1]), (SHAPE[0], 1))
    values[0] = np.nan
    found = as_disparity(values)
    reason = found.reason.copy()
    reason[1:, 40:] = Reason.FILLED
    return replace(found, reason=reason)


def test_what_was_inferred_becomes_points_only_where_it_is_asked_for(both):
    cloud = back_project(both, make_pair(), ALL)
    assert len(cloud) == 39 * 40
    assert cloud.inferred is None
    alone = back_project(both.only_measured(), make_pair(), ALL)
    for name, values in cloud.arrays.items():
        np.testing.assert_array_equal(values, alone.arrays[name])
    assert len(back_project(inferred_alone(both), make_pair(), ALL)) == 0


def inferred_alone(both: Disparity) -> Disparity:
    return both.reject(both.measured, Reason.LEFT_RIGHT)


def test_points_that_were_inferred_say_so(both):
    asked = ALL.model_copy(update={"inferred": True})
    cloud = back_project(both, make_pair(), asked)
    u, _, _ = project(cloud.xyz.astype(np.float64), CAMERA)
    np.testing.assert_array_equal(cloud.inferred, np.rint(u) >= 40)
    np.testing.assert_allclose(cloud.confidence, 0.7, rtol=1e-6)
    measured = back_project(both, make_pair(), ALL)
    np.testing.assert_array_equal(cloud.only_measured().xyz, measured.xyz)
    assert set(back_project(inferred_alone(both), make_pair(), asked).inferred) == {1}
    assert not back_project(both.only_measured(), make_pair(), asked).inferred.any()
    nothing = back_project(as_disparity(EMPTY), make_pair(), asked)
    assert (len(nothing), nothing.inferred.dtype) == (0, np.uint8)


def test_an_inferred_pixel_that_is_not_believed_at_all_is_still_marked(both):
    unsure = replace(both, confidence=np.zeros(SHAPE, np.float32))
    cloud = back_project(unsure, make_pair(), ALL.model_copy(update={"inferred": True}))
    assert cloud.inferred.sum() == 39 * 24
    assert not np.signbit(cloud.confidence).any()


def test_a_voxel_is_inferred_where_most_of_its_points_are():
    xyz = np.float32([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [5, 0, 0], [5.1, 0, 0]])
    thin = voxel_downsample(PointCloud(xyz, inferred=np.uint8([1, 0, 1, 0, 1])), 1.0)
    assert thin.inferred[np.argsort(thin.xyz[:, 0])].tolist() == [1, 0]


def smeared_step(width: int) -> np.ndarray:
    """A foreground of 40 px before a background of 10 px, with a linear ramp between them."""
    row = np.full(60, 10.0)
    row[30:] = 40.0
    row[30 : 30 + width] = np.linspace(10, 40, width + 2)[1:-1]
    return np.tile(row, (40, 1))


@pytest.mark.parametrize("width", [0, 1, 2, 3])
def test_a_step_loses_exactly_its_mixed_pixels(width):
    result = remove_flying_edges(as_disparity(smeared_step(width)))
    mixed = np.zeros((40, 60), dtype=bool)
    mixed[:, 30 : 30 + width] = True
    np.testing.assert_array_equal(result.reason == Reason.EDGE, mixed)


def test_mixed_columns_and_lone_pixels_go_and_a_pole_of_two_pixels_stays():
    values = smeared_step(1)
    values[:, 20:30] = np.nan
    result = remove_flying_edges(as_disparity(values))
    assert (result.reason[:, 30] == Reason.EDGE).all()
    assert result.valid[:, 32:].all()
    assert (result.reason[:, 20:30] == Reason.OCCLUDED).all()
    values = np.full((30, 40), 10.0)
    values[:, 20:22] = 50.0
    values[15, 8] = 30.0
    result = remove_flying_edges(as_disparity(values))
    assert np.argwhere(result.reason == Reason.EDGE).tolist() == [[15, 8]]


@given(across=st.floats(-0.7, 0.7), down=st.floats(-0.7, 0.7), noise_seed=st.integers(0, 2**16))
def test_slants_below_the_gradient_limit_stay(across, down, noise_seed):
    # 0.7 along each axis is a gradient of 1 at most; noise of ±0.25 differs by 0.5 at most.
    v, u = np.mgrid[:24, :30]
    noise = np.random.default_rng(noise_seed).uniform(-0.25, 0.25, u.shape)
    assert remove_flying_edges(as_disparity(60 + across * u + down * v + noise)).valid.all()


@pytest.mark.parametrize("shape", [(3, 3), (3, 200), (200, 4)])
def test_images_as_small_as_the_window_pass(shape):
    assert remove_flying_edges(as_disparity(np.full(shape, 5.0))).valid.all()
    assert not remove_flying_edges(as_disparity(np.full(shape, np.nan))).valid.any()


def wall_with_outliers() -> tuple[PointCloud, np.ndarray]:
    """A wall of 4 m × 3 m at 5 m, 4 cm between points, and 60 points far in front of it."""
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(np.arange(-2, 2, 0.04), np.arange(-1.5, 1.5, 0.04))
    wall = np.stack([x.ravel(), y.ravel(), 5 + 0.005 * rng.standard_normal(x.size)], axis=1)
    outliers = rng.uniform([-2, -1.5, 1.0], [2, 1.5, 4.0], (60, 3))
    xyz = np.concatenate([wall, outliers]).astype(np.float32)
    return PointCloud(xyz), np.arange(len(xyz)) < len(wall)


@pytest.mark.parametrize(
    "filtered", [partial(drop_islands, radius_m=0.15), partial(filter_cloud, settings=ANY_SCALE)]
)
def test_planted_outliers_go_and_the_planted_surface_stays(filtered):
    cloud, on_wall = wall_with_outliers()
    near_wall = filtered(cloud).xyz[:, 2] > 4.9
    assert near_wall.sum() >= 0.99 * on_wall.sum()
    assert (~near_wall).sum() <= 0.05 * (~on_wall).sum()
    assert filter_cloud(cloud, FilterSettings()) is cloud
    # 20 × 15 cells in the plane of the wall, its edges and outliers
    assert 300 < len(filter_cloud(cloud, FilterSettings(voxel_m=0.2))) < 900


def test_a_voxel_averages_every_attribute():
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


@pytest.mark.parametrize("points", [0, 1, 2])
def test_clouds_of_almost_nothing_pass(points):
    cloud = PointCloud(np.zeros((points, 3), dtype=np.float32))
    assert len(drop_islands(filter_cloud(cloud, ANY_SCALE), 0.3)) <= points


def frozen(xyz: np.ndarray) -> np.ndarray:
    array = np.ascontiguousarray(xyz, dtype=np.float32)
    array.flags.writeable = False
    return array


CLOUD = frozen(np.random.default_rng(5).random((400, 3)))


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
def test_points_that_are_not_finite_are_refused(call):
    with pytest.raises(ShapeError, match="not finite"):
        call(np.full((20, 3), np.nan, dtype=np.float32))


def test_no_foreign_exception_leaks():
    apart = PointCloud(np.array([[0, 0, 0], [1e6, 0, 0]], dtype=np.float32))
    with pytest.raises(SettingsError, match="voxel is too small"):
        filter_cloud(apart, FilterSettings(voxel_m=1e-5))
    with pytest.raises(ReconError):
        open3d_clouds.voxel_downsample(frozen(np.eye(3) * 1e9), np.zeros((3, 0)), 1e-9)
    with pytest.raises(ReconError, match="too few points"):
        open3d_clouds.nearest(CLOUD, CLOUD[:2], 3)
    with pytest.raises(ShapeError, match=r"too far apart to be searched \(got .*e\+30 m"):
        open3d_clouds.nearest(CLOUD * np.float32(1e31), CLOUD * np.float32(1e31))
