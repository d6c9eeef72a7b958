"""A drive divided into submaps gives the same map as an undivided one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.core.values import PointCloud
from recon.map import submaps as submaps_file
from recon.map.fusion import CloudBuilder, FusionSettings, join_fused
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.occupancy.builder import OccupancyBuilder, OccupancySettings
from recon.map.occupancy.part import OccupancyPart, join_occupancy
from recon.map.submaps import Submap, SubmapBuilder, SubmapSettings

T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
FUSION, OCCUPANCY = FusionSettings(min_count=1), OccupancySettings()
FRAMES = 24
Frame = tuple[PointCloud, PointCloud, np.ndarray]


def _frames() -> list[Frame]:
    """A wall to the right of a path of 1 m a frame."""
    rng = np.random.default_rng(0)
    frames = []
    for number in range(FRAMES):
        xyz = np.stack(
            [np.full(800, 2.03), rng.uniform(-1, 1, 800), rng.uniform(2, 12, 800)], axis=1
        )
        fields = {
            "rgb": rng.integers(0, 255, (800, 3)).astype(np.uint8),
            "normals": np.tile(np.float32([-1, 0, 0]), (800, 1)),
            "sigma_m": rng.uniform(0.05, 0.2, 800).astype(np.float32),
            "confidence": rng.uniform(0.2, 1, 800).astype(np.float32),
        }
        T = make_transform(np.eye(3), np.array([0.0, 0.0, float(number)]))
        here = PointCloud(xyz.astype(np.float32), **fields)
        there = PointCloud(apply(T, xyz).astype(np.float32), frame="world", **fields)
        frames.append((there, here, T))
    return frames


def _noisy(frames: list[Frame]) -> list[Frame]:
    """The frames with depths as wrong as they say."""
    rng = np.random.default_rng(1)
    noisy = []
    for there, here, T in frames:
        scale = 1 + here.sigma_m * rng.normal(size=len(here)) / here.xyz[:, 2]
        xyz = here.xyz * scale[:, None].astype(np.float32)
        noisy.append((there, replace(here, xyz=xyz), T))
    return noisy


def _builder(**settings: float) -> SubmapBuilder:
    return SubmapBuilder(SubmapSettings(**settings), FUSION, OCCUPANCY, T_MAP_WORLD)


def _submaps(builder: SubmapBuilder, frames: list[Frame]) -> list[Submap]:
    done = []
    for frame in frames:
        builder.integrate(*frame)
        if builder.full:
            done.append(builder.close())
    return [*done, builder.close()] if builder.frames else done


def test_submaps_put_together_are_the_map_of_the_whole_drive() -> None:
    submaps = _submaps(_builder(length_m=5.0), _frames())
    fused, occupancy = CloudBuilder(FUSION), OccupancyBuilder(OCCUPANCY, T_MAP_WORLD)
    for there, here, T in _frames():
        fused.integrate(there)
        occupancy.integrate(here, T)
    whole = fused.cloud()
    parts = join_fused(submap.fused for submap in submaps).cloud(FUSION.voxel_m, 1)
    assert len(submaps) > 3
    np.testing.assert_array_equal(parts.count, whole.count)
    # float32 sums in another order, rounded as maps keep them.
    for name, rtol, atol in (
        ("xyz", 0, 2e-5), ("normals", 0, 4e-3), ("sigma_m", 1e-4, 0), ("confidence", 3e-3, 0),
        ("weight", 3e-4, 0),
    ):  # fmt: skip
        got, expected = getattr(parts, name), getattr(whole, name)
        np.testing.assert_allclose(got, expected, rtol=rtol, atol=atol)
    joined = join_occupancy(submap.occupancy for submap in submaps)
    np.testing.assert_array_equal(joined.points.keys, occupancy.part().points.keys)
    # float32 sums in another order.
    np.testing.assert_allclose(
        joined.points.sums, occupancy.part().points.sums, rtol=1e-4, atol=1e-2
    )
    without = replace(submaps[1].occupancy, points=None)
    assert join_occupancy([submaps[0].occupancy, without]).points is None
    cells = joined.voxels(OCCUPANCY.resolution_m)
    order, ours = np.lexsort(occupancy.voxels().keys.T), np.lexsort(cells.keys.T)
    np.testing.assert_array_equal(cells.keys[ours], occupancy.voxels().keys[order])
    np.testing.assert_allclose(
        cells.log_odds[ours], occupancy.voxels().log_odds[order], atol=1e-5
    )  # float32


@pytest.mark.parametrize(
    ("settings", "sizes"), [({"length_m": 10.0}, [11, 10, 3]), ({"length_m": 1000.0}, [9, 9, 6])]
)
def test_a_submap_ends_after_its_path_or_its_frames(
    settings: dict[str, float], sizes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(submaps_file, "_MAX_FRAMES", 9 if sizes[0] == 9 else 100)
    submaps = _submaps(_builder(**settings), _frames())
    assert [submap.frames for submap in submaps] == sizes
    assert [submap.index for submap in submaps] == [0, 1, 2]
    assert [submap.first_frame for submap in submaps] == [0, sizes[0], sizes[0] + sizes[1]]
    small = SubmapBuilder(SubmapSettings(), FUSION, OCCUPANCY, T_MAP_WORLD, max_bytes=1)
    assert [submap.frames for submap in _submaps(small, _frames()[:3])] == [1, 1, 1]


def test_a_builder_goes_on_from_the_state_of_another() -> None:
    frames = _frames()
    first = _builder(length_m=8.0)
    done = _submaps(first, [])
    for frame in frames[:13]:
        first.integrate(*frame)
        if first.full:
            done.append(first.close())
    second = _builder(length_m=8.0)
    second.restore(first.state())
    unbroken = _submaps(_builder(length_m=8.0), frames)
    resumed = [*done, *_submaps(second, frames[13:])]
    resumed = [Submap.from_tree(submap.to_tree()) for submap in resumed]
    assert len(resumed) == len(unbroken)
    for ours, theirs in zip(resumed, unbroken, strict=True):
        np.testing.assert_array_equal(ours.fused.keys, theirs.fused.keys)
        np.testing.assert_array_equal(ours.fused.sums, theirs.fused.sums)
        np.testing.assert_array_equal(ours.fused.information, theirs.fused.information)
        for mine, other in zip(ours.occupancy.rows, theirs.occupancy.rows, strict=True):
            np.testing.assert_array_equal(mine, other)
        np.testing.assert_array_equal(ours.occupancy.points.keys, theirs.occupancy.points.keys)
        np.testing.assert_array_equal(ours.occupancy.points.sums, theirs.occupancy.points.sums)


def _occupied(part: OccupancyPart) -> np.ndarray:
    """Centres of the voxels that are surely occupied, metres."""
    voxels = part.voxels(OCCUPANCY.resolution_m)
    return voxels.centres_m[voxels.log_odds > 0.2]


def test_a_corrected_submap_keeps_its_wall_thin() -> None:
    [submap] = _submaps(_builder(length_m=1000.0), _noisy(_frames()))
    T = make_transform(exp_so3(np.array([0.0, 0.2, 0.0])), np.array([0.7, -0.2, 3.0]))
    moved = submap.moved(T, T_MAP_WORLD, FUSION.voxel_m, OCCUPANCY.resolution_m)
    places = _occupied(moved.occupancy)
    back = apply(T_MAP_WORLD @ np.linalg.inv(T) @ np.linalg.inv(T_MAP_WORLD), places)
    assert len(places) > 0.8 * len(_occupied(submap.occupancy))
    # A voxel that a plane crosses has its centre at most half a diagonal from it.
    assert (np.abs(back[:, 1] + 2.03) < 0.18).mean() > 0.99


@pytest.fixture(scope="module")
def submap() -> Submap:
    return _submaps(_builder(length_m=1000.0), _frames())[0]


def test_a_corrected_submap_has_its_points_where_the_correction_puts_them(submap: Submap) -> None:
    T = make_transform(exp_so3(np.array([0.0, 0.03, 0.0])), np.array([0.7, -0.2, 3.0]))
    moved = submap.moved(T, T_MAP_WORLD, FUSION.voxel_m, OCCUPANCY.resolution_m)
    before, after = (s.fused.cloud(FUSION.voxel_m, 1) for s in (submap, moved))
    assert 0.8 * len(before) < len(after) <= len(before)
    gaps = np.linalg.norm(apply(T, before.xyz)[:, None] - after.xyz[None], axis=2).min(axis=1)
    # Means of voxels that come to lie in one are at most a voxel's diagonal away.
    assert gaps.max() < 0.18
    np.testing.assert_allclose(
        after.normals, np.tile(T[:3, :3] @ [-1, 0, 0], (len(after), 1)), atol=1e-5
    )  # float32
    assert moved.fused.sums[:, 0].sum() == pytest.approx(submap.fused.sums[:, 0].sum(), rel=1e-5)
    assert moved.fused.frames.max() <= submap.frames


def test_a_corrected_submap_has_its_walls_where_the_correction_puts_them(submap: Submap) -> None:
    T = make_transform(np.eye(3), np.array([0.8, 0.0, 2.0]))
    moved = submap.moved(T, T_MAP_WORLD, FUSION.voxel_m, OCCUPANCY.resolution_m)
    before, after = (s.occupancy.voxels(OCCUPANCY.resolution_m) for s in (submap, moved))
    # 2 m forward and 0.8 m to the right: map x + 10 cells, y - 4 cells.
    expected = {(i + 10, j - 4, k) for i, j, k in before.keys.tolist()}
    assert {tuple(key) for key in after.keys.tolist()} == expected
    assert after.log_odds.sum() == pytest.approx(before.log_odds.sum(), rel=1e-4)
