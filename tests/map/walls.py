"""Drives along a wall, seen by a camera that is put on it."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from recon.commands.config import ReconConfig, load_config
from recon.core.geometry.se3 import exp_so3, invert, make_transform, transform_cloud
from recon.core.values import OccupancyVoxels, PointCloud, RectifiedCamera, join_clouds, join_voxels
from recon.core.values.arrays import Float64
from recon.map.builders import ray_grain, thin_rays
from recon.map.drive.mapper import SubmapBuilder
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.map import Map
from recon.map.store.session import Session, SessionInfo
from recon.map.store.trees import Link
from recon.map.tiles import Tiles
from recon.odometry.protocol import OdometryHealth
from recon.places.places import Loop

CONFIG = load_config(None, ["submaps.length_m=8", "fusion.min_count=1"])
CAMERA = RectifiedCamera(100.0, 9.0, 5.0, 9.0, 0.5, 20, 12)
T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
WALL_M = 3.03
FRAMES = 20


def poses(start_m: float, turn_rad: float = 0.0) -> Float64:
    """True poses of a drive along a wall, in the world of the first drive."""
    turn = exp_so3(np.array([0.0, turn_rad, 0.0]))
    return np.stack(
        [make_transform(turn, np.array([0.0, 0.0, start_m + n])) for n in range(FRAMES)]
    )


TRUE = poses(0.0), poses(12.0, 0.05), poses(5.0, -0.04)


def wall(T_true: Float64, seed: int) -> PointCloud:
    rng = np.random.default_rng(seed)
    z = T_true[2, 3] + rng.uniform(1, 8, 600)
    points = np.stack([np.full(600, WALL_M), rng.uniform(-1, 1, 600), z], axis=1)
    cloud = PointCloud(
        points.astype("f4"),
        rgb=rng.integers(0, 256, (600, 3)).astype(np.uint8),
        normals=np.tile(np.float32([-1, 0, 0]), (600, 1)),
        sigma_m=rng.uniform(0.04, 0.06, 600).astype("f4"),
        frame="world",
    )
    return transform_cloud(cloud, invert(T_true), frame="camera")


def drive(
    map_: Map, true: Float64, seed: int, name: str = "wall", drift: float = 0.0, first: int = 0,
    noise: int = 0, health: Mapping[int, OdometryHealth] = MappingProxyType({}),
    config: ReconConfig = CONFIG,
) -> Session:  # fmt: skip
    """Map a drive whose own world begins with its first camera; ``drift`` stretches its path.

    ``health`` of some frames is not good; where a segment ends, a submap does.
    Drives of one ``seed`` without other ``noise`` have the same images, from frame ``first`` on.
    """
    session = map_.begin(SessionInfo(name, "of a test", len(true), config.model_dump(mode="json")))
    session.set_axes(T_MAP_WORLD, CAMERA)
    builder = SubmapBuilder(config.submaps, config.fusion, config.occupancy, T_MAP_WORLD)
    records = [health.get(frame, OdometryHealth()) for frame in range(len(true))]
    for frame, T_true in enumerate(true):
        T = invert(true[0]) @ T_true
        T[:3, 3] *= 1 + drift
        cloud = wall(T_true, 1000 * seed + first + frame + 500 * noise)
        if not records[frame].ok:
            cloud = cloud.select(np.zeros(0, np.intp))
        rays = thin_rays(cloud, config.occupancy)
        builder.integrate(transform_cloud(cloud, T, frame="world"), rays.cloud(), T)
        session.add_frame(T, 0.1 * (first + frame) + seed, records[frame])
        session.add_rays(frame, rays, ray_grain(config.occupancy))
        if builder.full or frame == len(true) - 1 or not records[frame].ok:
            session.submaps.add(builder.close())
    return session


def links_between(one: int, other: int, true: tuple[Float64, ...], off_m: float = 0) -> list[Link]:
    """Places that two drives saw, where their paths are side by side."""
    found = []
    for last in range(0, FRAMES, 3):
        first = int(np.argmin(np.linalg.norm(true[0][:, :3, 3] - true[1][last, :3, 3], axis=1)))
        T = invert(true[0][first]) @ true[1][last]
        T[2, 3] += off_m * (last % 2)
        found.append(Link((one, other), Loop(first, last, T, 1e4 * np.eye(6), 50, 0.9)))
    return found


def drives(count: int, drift: float = 0.0, apart: int = 1) -> Map:
    """A map of so many drives that nothing links; ``apart`` in seconds."""
    map_ = Map.temporary()
    for number in range(count):
        drive(map_, TRUE[number], apart * number, drift=drift)
    map_.commit()
    return map_


def off_m(map_: Map, number: int) -> float:
    """By how much the path of a drive is off in the world of the map, at most."""
    session = map_.session(number)
    T = map_.T_world_session(session) @ session.trajectory.T_world_camera
    return float(np.linalg.norm((T - TRUE[number])[:, :3, 3], axis=1).max())


def put_cloud(tiles: Tiles, cloud: PointCloud) -> None:
    """Add points to tiles as if they had been fused and filtered there, frame ``map``."""
    for key, inside in tiles._parts.near(cloud.xyz, 0.0):
        tiles._parts.put("points", key, cloud.select(inside).arrays)


def put_voxels(tiles: Tiles, voxels: OccupancyVoxels) -> None:
    """Add voxels that were observed, none twice."""
    for key, inside in tiles._parts.near(voxels.centres_m, 0.0):
        part = voxels.select(inside)
        tiles._parts.put("voxels", key, {"keys": part.keys, "log_odds": part.log_odds})


def cloud_of(tiles: Tiles) -> PointCloud:
    cloud = join_clouds(tile.cloud for tile in tiles)
    return cloud.select(np.lexsort(cloud.xyz.T))


def voxels_of(tiles: Tiles) -> OccupancyVoxels:
    return in_order(join_voxels((tile.voxels for tile in tiles), tiles.resolution_m))


def in_order(voxels: OccupancyVoxels) -> OccupancyVoxels:
    return voxels.select(np.lexsort(voxels.keys.T))


def assert_same_voxels(ours: OccupancyVoxels, theirs: OccupancyVoxels, atol: float = 0.0) -> None:
    ours, theirs = in_order(ours), in_order(theirs)
    np.testing.assert_array_equal(ours.keys, theirs.keys)
    np.testing.assert_allclose(ours.log_odds, theirs.log_odds, rtol=0, atol=atol)


def frames(count: int, noisy: bool = False) -> list[tuple[PointCloud, PointCloud, Float64]]:
    """Frames 1 m apart: cloud in the world, cloud in the camera (as wrong as it says), pose."""
    rng, found = np.random.default_rng(1), []
    for number in range(count):
        T = make_transform(np.eye(3), np.array([0.0, 0.0, float(number)]))
        there = here = wall(T, number)
        if noisy:
            scale = 1 + here.sigma_m * rng.normal(size=len(here)) / here.xyz[:, 2]
            here = replace(here, xyz=here.xyz * scale[:, None].astype("f4"))
        found.append((transform_cloud(there, T, frame="world"), here, T))
    return found
