"""From clouds and poses to the occupancy of space: log-odds of voxels, by ray casting."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.errors import MappingError
from recon.geometry.se3 import apply
from recon.kernels import raycast, voxels
from recon.settings import Settings
from recon.structures import OccupancyVoxels, PointCloud
from recon.structures.arrays import Float32, Float64


class OccupancySettings(Settings):
    """How clouds become occupancy. The defaults of the probabilities are OctoMap's."""

    resolution_m: float = Field(0.2, gt=0.0, le=10.0, description="Edge of a voxel.")
    max_range_m: float = Field(
        25.0, gt=0.0, le=1000.0, description="Points farther away hit nothing."
    )
    hit_probability: float = Field(
        0.7, gt=0.5, lt=1.0, description="Occupancy of a voxel after one certain hit."
    )
    miss_probability: float = Field(
        0.4, gt=0.0, lt=0.5, description="Occupancy of a voxel after one ray went through it."
    )
    min_probability: float = Field(
        0.12, gt=0.0, lt=0.5, description="Lower clamp: keeps the map able to change."
    )
    max_probability: float = Field(0.97, gt=0.5, lt=1.0, description="Upper clamp.")
    free_margin_sigmas: float = Field(
        2.0,
        ge=0.0,
        le=10.0,
        description="Free space ends this many standard deviations before the point.",
    )
    spread_sigmas: float = Field(
        1.0,
        ge=0.0,
        le=5.0,
        description="Voxels within this many standard deviations of the point share its hit.",
    )
    min_points: int = Field(
        2, ge=1, le=1000, description="Voxels with fewer points in a frame start no ray."
    )


class OccupancyBuilder:
    """Integrates clouds frame by frame into log-odds.

    The points of a frame are first reduced to one ray per voxel that they end in; then each
    voxel is updated at most once per frame, and a hit outweighs misses (OctoMap's rule).

    Args:
        settings: How to integrate.
        T_map_world: float64 (4, 4), from world to map axes (z up).
    """

    def __init__(self, settings: OccupancySettings, T_map_world: NDArray[Any]) -> None:
        self._settings = settings
        self._T_map_world = np.asarray(T_map_world, dtype=np.float64)
        self._blocks = raycast.make_blocks(256)
        self._table = voxels.make_table(256)
        self._evidence = raycast.make_evidence(256)

    def integrate(self, cloud: PointCloud, T_world_camera: NDArray[Any]) -> None:
        """Add what one frame saw.

        Args:
            cloud: Points in camera axes. ``sigma_m`` None = exact; ``confidence`` None = 1.
            T_world_camera: float64 (4, 4), pose of the camera.

        Raises:
            MappingError: The cloud is not in camera axes, or a point or pose is not finite or
                too far away.
        """
        _check(cloud, T_world_camera, self._settings.resolution_m)
        T_map_camera = self._T_map_world @ T_world_camera
        rays = self._rays(cloud, T_map_camera)
        self._cast(rays)
        s = self._settings
        low, high = _log_odds(s.min_probability), _log_odds(s.max_probability)
        raycast.apply_evidence(self._blocks, self._evidence, low, high)

    def voxels(self) -> OccupancyVoxels:
        """Every voxel that was observed so far, block by block as first touched."""
        used = int(self._blocks.used[0])
        log_odds = self._blocks.log_odds[:used]
        block, cell = np.nonzero(~np.isnan(log_odds))
        edge = raycast.BLOCK_EDGE
        corner = voxels.unpack_keys(self._blocks.keys[:used]) * edge
        local = np.stack(np.unravel_index(cell, (edge, edge, edge)), axis=1)
        return OccupancyVoxels(
            keys=(corner[block] + local).astype(np.int32),
            log_odds=log_odds[block, cell],
            resolution_m=self._settings.resolution_m,
        )

    def _rays(self, cloud: PointCloud, T_map_camera: Float64) -> raycast.Rays:
        """One ray per end voxel, in voxels; points out of range become rays that hit nothing."""
        s = self._settings
        origin = T_map_camera[:3, 3]
        range_m, sigma, confidence = _measurements(cloud)
        xyz = apply(T_map_camera, cloud.xyz.astype(np.float64))
        beyond = range_m > s.max_range_m
        # What lies beyond is moved to the end of the range before it is reduced, so that a
        # distant hedge does not cost a ray per voxel.
        shrink = np.where(beyond, s.max_range_m / np.maximum(range_m, s.max_range_m), 1.0)
        xyz = origin + (xyz - origin) * shrink[:, None]
        free = np.minimum(range_m - s.free_margin_sigmas * sigma, s.max_range_m - s.resolution_m)
        values = np.stack([sigma, free, confidence], axis=1).astype(np.float32)
        hit_ends, hit_means = _reduce(xyz[~beyond], values[~beyond], s)
        far_ends, far_means = _reduce(xyz[beyond], values[beyond], s)
        ends = np.concatenate([hit_ends, far_ends]) / s.resolution_m
        sigma, free, confidence = np.concatenate([hit_means, far_means]).T.astype(np.float64)
        hit = np.where(np.arange(len(ends)) < len(hit_ends), _log_odds(s.hit_probability), 0.0)
        return raycast.Rays(
            origin=origin / s.resolution_m,
            ends=ends,
            free=free / s.resolution_m,
            sigma=sigma / s.resolution_m,
            hit=(hit * confidence).astype(np.float32),
            miss=(_log_odds(s.miss_probability) * confidence).astype(np.float32),
        )

    def _cast(self, rays: raycast.Rays) -> None:
        """Collect the evidence of all rays; grow the stores where they are full."""
        done, spread = 0, self._settings.spread_sigmas
        while True:
            done = raycast.cast_rays(self._table, self._blocks, self._evidence, rays, done, spread)
            if done == len(rays.ends):
                return
            self._grow()

    def _grow(self) -> None:
        """Make room for at least one more block everywhere."""
        used = int(self._blocks.used[0])
        self._blocks = raycast.reserve_blocks(self._blocks, used + 1)
        self._evidence = raycast.reserve_evidence(self._evidence, int(self._evidence.used[0]) + 1)
        self._table = voxels.reserve_table(self._table, self._blocks.keys[:used], used + 1)


def _measurements(cloud: PointCloud) -> tuple[Float64, Float64, Float64]:
    """Range, its standard deviation, and confidence of each point; float64 (N,), metres."""
    xyz = cloud.xyz.astype(np.float64)
    range_m = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    n = len(cloud)
    # sigma_z lies along the optical axis: along an oblique ray it is longer.
    stretch = range_m / np.maximum(np.abs(xyz[:, 2]), 1e-3)
    sigma = np.zeros(n) if cloud.sigma_m is None else cloud.sigma_m * stretch
    confidence = np.ones(n) if cloud.confidence is None else cloud.confidence.astype(np.float64)
    return range_m, sigma, confidence


def _reduce(xyz: Float64, values: Float32, settings: OccupancySettings) -> tuple[Float64, Float32]:
    """Means of the points (M, 3) and values (M, C) of each voxel that holds enough points."""
    edge = settings.resolution_m
    table, sums = voxels.make_table(len(xyz)), voxels.make_sums(len(xyz), values.shape[1])
    points = voxels.VoxelPoints(xyz, np.ones(len(xyz), np.float32), values)
    voxels.sum_points(table, sums, points, edge, 0)
    enough = np.flatnonzero(sums.sums[: sums.used[0], 0] >= settings.min_points)
    means = sums.sums[enough, 1:] / sums.sums[enough, :1]
    centres = (voxels.unpack_keys(sums.keys[enough]) + 0.5) * edge
    return centres + means[:, :3], means[:, 3:]


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


def _check(cloud: PointCloud, T_world_camera: NDArray[Any], resolution_m: float) -> None:
    """Refuse what would silently spoil the map."""
    if cloud.frame != "camera":
        raise MappingError(
            "the occupancy map takes clouds in camera axes", got=cloud.frame, expected="camera"
        )
    numbers = (cloud.xyz, T_world_camera, cloud.sigma_m, cloud.confidence)
    if not all(a is None or np.isfinite(a).all() for a in numbers):
        raise MappingError("a point or pose to map is not finite")
    far_m = resolution_m * (voxels.KEY_LIMIT / 2)
    if np.abs(T_world_camera[:3, 3]).max() > far_m:
        raise MappingError(
            "the camera is too far from the origin for this resolution",
            got=f"{np.abs(T_world_camera[:3, 3]).max():.0f} m",
            expected=f"at most {far_m:.0f} m",
        )
