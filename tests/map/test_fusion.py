"""Fusion averages the measurements of frames, and counts frames, not points."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.geometry.projection import depth_sigma
from recon.core.geometry.se3 import exp_so3, invert, make_transform, transform_cloud
from recon.core.values import PointCloud, RectifiedCamera
from recon.map import fusion
from recon.map.fusion import CloudBuilder, FusionSettings, fusion_range_m, join_fused


def _cloud(xyz: np.ndarray, **fields: np.ndarray) -> PointCloud:
    return PointCloud(np.asarray(xyz, np.float32), frame="world", **fields)


def _build(*clouds: PointCloud, **settings: float | None) -> CloudBuilder:
    builder = CloudBuilder(FusionSettings(**settings))
    for cloud in clouds:
        builder.integrate(cloud)
    return builder


def _wall(seed: int, n: int = 3000, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (n, 3))
    points[:, 2] = 5.05 + noise * rng.normal(size=n)
    return points


def test_voxels_seen_too_rarely_are_not_exported() -> None:
    often, once = np.full((1, 3), 0.05), np.full((1, 3), 1.05)
    builder = _build(_cloud(np.vstack([often, once])), _cloud(often), _cloud(often), min_count=3)
    assert len(builder) == 2
    assert builder.cloud().xyz.tolist() == pytest.approx(np.float32(often))
    assert len(builder.cloud(min_count=1)) == 2


def test_precise_voxels_need_one_frame_less(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = np.array([[0.05, 0.05, 0.05], [1.05, 1.05, 1.05]])
    # Two frames of 0.1 m make 0.071 m, two of 0.15 m make 0.106 m.
    cloud = _cloud(xyz, sigma_m=np.array([0.1, 0.15], np.float32))
    builder = _build(cloud, cloud, min_count=3)
    for limit_m, exported in ((0.08, 1), (0.07, 0), (0.11, 2)):
        monkeypatch.setattr(fusion, "PRECISE_SIGMA_M", limit_m)
        assert len(builder.cloud()) == exported
    monkeypatch.setattr(fusion, "PRECISE_SIGMA_M", 10.0)
    once = _build(cloud, min_count=3)
    assert len(once.cloud()) == 0
    assert len(once.cloud(min_count=1)) == 2


def test_precise_points_pull_the_mean_by_the_square_of_their_precision() -> None:
    xyz = np.array([[0.02, 0.05, 0.05], [0.07, 0.05, 0.05]])
    sigma = np.array([0.1, 0.2], np.float32)
    fused = _build(_cloud(xyz, sigma_m=sigma)).cloud(1)
    assert fused.xyz[0, 0] == pytest.approx((4 * 0.02 + 0.07) / 5, abs=1e-6)
    assert fused.weight[0] == pytest.approx(100 + 25, rel=1e-5)


def test_precision_is_bounded_and_hopeless_points_are_left_out() -> None:
    xyz = np.array([[0.05, 0.05, 0.05], [0.05, 0.05, 0.05], [3.0, 3.0, 3.0]])
    sigma = np.array([1e-9, 0.02, 5.0], np.float32)
    fused = _build(_cloud(xyz, sigma_m=sigma)).cloud(1)
    assert len(fused) == 1
    assert fused.weight[0] == pytest.approx(2 / 0.02**2, rel=1e-5)


@pytest.mark.parametrize(
    ("points", "frames", "sigma_m"), [(1, 1, 0.1), (50, 1, 0.1), (50, 4, 0.05)]
)
def test_frames_count_and_not_points(points: int, frames: int, sigma_m: float) -> None:
    cloud = _cloud(np.full((points, 3), 0.05), sigma_m=np.full(points, 0.1, np.float32))
    fused = _build(*[cloud] * frames).cloud(1)
    assert fused.sigma_m == pytest.approx([sigma_m], rel=1e-5)
    assert fused.count.tolist() == [frames]


def test_colours_and_places_are_averaged_by_confidence_and_opposite_normals_cancel() -> None:
    xyz = np.float32([[0.05] * 3] * 3 + [[1.05, 0.05, 0.05]] * 2)
    rgb = np.uint8([[0, 100, 255], [200, 100, 255], [9, 9, 9], [0] * 3, [0] * 3])
    up = np.float32([[0, 0, 1]] * 4 + [[0, 0, -1]])
    confidence = np.float32([0.25, 0.75, 0.0, 0.5, 0.5])
    fused = _build(_cloud(xyz, rgb=rgb, normals=up, confidence=confidence)).cloud(1)
    assert fused.xyz == pytest.approx(np.float32([[0.05] * 3]), abs=1e-6)
    assert fused.rgb.tolist() == [[150, 100, 255]]
    assert fused.confidence.tolist() == [0.625]


def test_fusing_a_noisy_wall_is_more_precise_than_a_frame() -> None:
    frames = [_cloud(_wall(seed, 20_000, noise=0.01)) for seed in range(8)]
    error = _build(*frames).cloud().xyz[:, 2] - 5.05
    # 160 000 points on 1600 voxels (5 standard deviations thick): 0.01 / sqrt(100) = 0.001.
    assert 0.0005 < np.sqrt((error**2).mean()) < 0.0015


def test_normals_are_unit_vectors_and_keep_their_side() -> None:
    rng = np.random.default_rng(0)
    normals = np.array([0.0, 0.0, -1.0]) + rng.normal(0, 0.2, (3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fused = _build(_cloud(_wall(1), normals=normals.astype(np.float32))).cloud(1).normals
    np.testing.assert_allclose(np.linalg.norm(fused, axis=1), 1, atol=1e-5)  # float32
    assert (fused[:, 2] < -0.5).all()


def test_what_one_cloud_does_not_have_the_map_does_not_have() -> None:
    xyz = np.full((1, 3), 0.05)
    with_colour = _cloud(xyz, rgb=np.zeros((1, 3), np.uint8))
    assert _build(with_colour).cloud(1).rgb is not None
    fused = _build(with_colour, _cloud(xyz)).cloud(1)
    assert fused.rgb is None
    assert fused.normals is None
    assert fused.sigma_m is None


def test_a_part_is_gone_on_with_as_if_it_had_not_been_taken() -> None:
    xyz = np.full((1, 3), 0.05)
    plain, coloured = _cloud(xyz), _cloud(xyz, rgb=np.full((1, 3), 9, np.uint8))
    for before, rgb in (([coloured], [[9, 9, 9]]), ([plain], None), ([], [[9, 9, 9]])):
        builder = CloudBuilder(FusionSettings())
        builder.resume(_build(*before).part(), len(before))
        builder.integrate(coloured)
        found, whole = builder.cloud(1), _build(*before, coloured).cloud(1)
        assert (None if found.rgb is None else found.rgb.tolist()) == rgb
        np.testing.assert_array_equal(found.count, whole.count)
        np.testing.assert_array_equal(found.xyz, whole.xyz)


def test_empty_frames_and_an_empty_map_are_fine() -> None:
    empty = _cloud(np.zeros((0, 3)))
    assert len(_build().cloud()) == 0
    assert len(_build(empty).cloud(1)) == 0
    assert len(_build(empty, _cloud(np.full((1, 3), 0.05))).cloud(1)) == 1


def test_the_map_does_not_depend_on_how_its_stores_grew() -> None:
    points = _wall(3, 5000)
    halves = [_cloud(points[:2500]), _cloud(points[2500:])]
    whole = _build(_cloud(points)).cloud(1)
    parts = _build(*halves).cloud(1)
    # Same points, same order; float32 sums in the same order are the same bits.
    np.testing.assert_array_equal(whole.xyz, parts.xyz)


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (PointCloud(np.zeros((1, 3), np.float32)), "world axes"),
        (_cloud([[np.nan, 0, 0]]), "not finite"),
        (_cloud([[1e9, 0, 0]]), "too far"),
        (_cloud([[0, 0, 0]], sigma_m=np.array([np.nan], np.float32)), "not finite"),
    ],
)
def test_clouds_that_would_spoil_the_map_are_refused(cloud: PointCloud, words: str) -> None:
    with pytest.raises(MappingError, match=words):
        _build(cloud)


def test_fusion_range_is_where_the_nominal_error_reaches_its_limit() -> None:
    camera = RectifiedCamera(700.0, 320.0, 120.0, 320.0, 0.5, 640, 240)
    settings = FusionSettings(max_depth_error_m=0.2)
    range_m = fusion_range_m(camera, settings)
    assert depth_sigma(np.array([range_m]), 0.3, camera)[0] == pytest.approx(0.2, rel=1e-6)
    assert fusion_range_m(camera, FusionSettings(max_depth_error_m=None)) == np.inf


def _street(seed: int, noise_m: float = 0.02) -> PointCloud:
    """What one frame sees of a slope and a wall: fewer points in a voxel far away than near."""
    rng = np.random.default_rng(seed)
    n = 6000
    across, up, far = rng.uniform(-1.5, 1.5, n), rng.uniform(0, 3, n), 8 * rng.uniform(0, 1, n) ** 2
    slope = np.stack([across, 0.04 + 0.1 * far, far], axis=1)
    wall = np.stack([1.54 + 0.2 * far, up, far], axis=1)
    normals = np.repeat(np.array([[0, -1, 0.1], [-1, 0, 0.2]]), n, axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    xyz = np.concatenate([slope, wall]) + noise_m * rng.normal(size=(2 * n, 1)) * normals
    sigma_m = np.full(2 * n, 0.1, np.float32)
    return _cloud(xyz, normals=normals.astype(np.float32), sigma_m=sigma_m)


def _farthest_m(ours: np.ndarray, theirs: np.ndarray, share: float) -> float:
    """Distance from our points to the nearest of theirs that a share of them keeps."""
    nearest = [np.linalg.norm(theirs - point, axis=1).min() for point in ours[::7]]
    return float(np.quantile(nearest, share))


@pytest.mark.xfail(strict=True, reason="a voxel is moved as one point, so points are missing")
def test_frames_fused_in_one_session_and_in_two_give_the_same_points() -> None:
    frames = [_street(seed) for seed in range(10)]
    T = make_transform(exp_so3(np.array([0.02, 0.05, -0.01])), np.array([0.33, 0.17, 0.46]))
    there = [transform_cloud(cloud, invert(T), frame="world") for cloud in frames[1::2]]
    odd = _build(*there).part().moved(T, 0.1)
    one = _build(*frames).cloud().xyz
    two = join_fused([_build(*frames[::2]).part(), odd]).cloud(0.1, 3).xyz
    assert len(two) == pytest.approx(len(one), rel=0.02)
    assert max(_farthest_m(one, two, 0.95), _farthest_m(two, one, 0.95)) < 0.1
