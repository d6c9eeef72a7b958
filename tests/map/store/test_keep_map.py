"""A finished map gives the occupancy of the run exactly, and its cloud up to rounding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import FormatError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import PointCloud, RectifiedCamera
from recon.map.fusion import FusedPart, join_fused
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.map import Map
from recon.map.occupancy.builder import ray_grain, thin_rays
from recon.map.occupancy.part import join_occupancy
from recon.map.sessions.placed import PlacedSubmaps
from recon.map.store.finished import keep_map
from recon.map.store.session import Session, SessionInfo
from recon.map.submaps import SubmapBuilder
from recon.odometry.protocol import OdometryHealth

CONFIG = load_config(None, ["submaps.length_m=4"])
CAMERA = RectifiedCamera(100.0, 9.0, 5.0, 9.0, 0.5, 20, 12)
T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
VOXEL_M = CONFIG.fusion.voxel_m
FRAMES = 14
BEND = make_transform(exp_so3(np.array([0.0, 0.02, 0.0])), np.array([0.0, 0.0, 0.31]))


def _mapped(made: Map) -> Session:
    """A drive along a wall."""
    rng = np.random.default_rng(1)
    session = made.begin(SessionInfo("wall", "of a test", FRAMES, start={"identity": {}}))
    session.set_axes(T_MAP_WORLD, CAMERA)
    builder = SubmapBuilder(CONFIG.submaps, CONFIG.fusion, CONFIG.occupancy, T_MAP_WORLD)
    for frame in range(FRAMES):
        xyz = np.stack(
            [np.full(900, 2.03), rng.uniform(-1, 1, 900), rng.uniform(2, 9, 900)], axis=1
        ).astype(np.float32)
        fields = {
            "rgb": rng.integers(0, 256, (900, 3)).astype(np.uint8),
            "sigma_m": rng.uniform(0.05, 0.2, 900).astype(np.float32),
            "normals": np.tile(np.float32([-1, 0, 0]), (900, 1)),
        }
        T = make_transform(np.eye(3), np.array([0.0, 0.0, float(frame)]))
        rays = thin_rays(PointCloud(xyz, **fields), CONFIG.occupancy)
        world = PointCloud(xyz + np.float32([0, 0, frame]), frame="world", **fields)
        builder.integrate(world, rays.cloud(), T)
        session.add_frame(T, 0.1 * frame, OdometryHealth())
        session.add_rays(frame, rays, ray_grain(CONFIG.occupancy))
        if builder.full or frame == FRAMES - 1:
            session.submaps.add(builder.close())
    session.set_state({"odometry": None})
    return session


def _cloud(session: Session) -> PointCloud:
    corrections = session.corrections()
    parts: list[FusedPart] = []
    for index, submap in enumerate(session.submaps):
        fused = submap.fused
        parts.append(fused if corrections is None else fused.moved(corrections[index], VOXEL_M))
    settings = CONFIG.fusion
    cloud = join_fused(parts).cloud(VOXEL_M, settings.min_count)
    return cloud.select(np.lexsort(np.floor(cloud.xyz / VOXEL_M).T))


def test_occupancy_is_that_of_the_run(tmp_path: Path) -> None:
    with Map.temporary() as made:
        session = _mapped(made)
        assert len(session.submaps) >= 3
        keep_map(made, tmp_path / "map.recon")
        before = join_occupancy(submap.occupancy for submap in session.submaps).voxels(0.2)
        poses = session.trajectory.T_world_camera
    with Map.open(tmp_path / "map.recon", read_only=False) as kept:
        assert not any(len(submap.occupancy) for submap in kept.session().submaps)
        # What only resuming needs is left out.
        assert "state" not in kept.store.kinds()
        assert kept.session().info.start == {}
        np.testing.assert_array_equal(kept.session().trajectory.T_world_camera, poses)
        after = join_occupancy(one.occupancy for one in PlacedSubmaps(kept, CONFIG)).voxels(0.2)
        kept.store.delete("submap_entry", (0, len(kept.session().submaps) - 1))
        kept.commit()
    np.testing.assert_array_equal(before.keys, after.keys)
    np.testing.assert_array_equal(before.log_odds, after.log_odds)
    with Map.open(tmp_path / "map.recon") as lacking, pytest.raises(FormatError, match="submaps"):
        PlacedSubmaps(lacking, CONFIG)


@pytest.mark.parametrize("closed", [False, True])
def test_the_cloud_is_that_of_the_run(tmp_path: Path, closed: bool) -> None:
    with Map.temporary() as made:
        session = _mapped(made)
        if closed:
            path = session.odometry.T_world_camera
            path = np.concatenate([path[: FRAMES // 2], BEND @ path[FRAMES // 2 :]])
            session.set_loops({"closed": [], "refused": [], "T_world_camera": path})
        keep_map(made, tmp_path / "map.recon")
        before = _cloud(session)
    with Map.open(tmp_path / "map.recon") as kept:
        after = _cloud(kept.session())
    assert len(before) > 500
    for name in ("xyz", "rgb", "sigma_m", "count"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_submaps_move_with_their_middle_frames() -> None:
    with Map.temporary() as made:
        session = _mapped(made)
        assert session.corrections() is None
        path = session.odometry.T_world_camera
        bent = np.stack([BEND @ T if n % 2 else T for n, T in enumerate(path)])
        session.set_loops({"closed": [], "refused": [], "T_world_camera": bent})
        corrections = session.corrections()
        for entry, T in zip(session.submaps.entries, corrections, strict=True):
            np.testing.assert_allclose(T @ path[entry.middle], bent[entry.middle], atol=1e-9)
