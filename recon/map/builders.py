"""Submaps, and what frames add to them: sums per voxel of the cloud, log-odds of cells by rays.

A submap is consecutive frames, built in the world of the odometry. Where loop closure moves it, its
voxels are moved with it, and nothing is matched again.

Occupancy is built from the rays that are kept of each frame, points averaged in small cubes and
rounded, so that the same map can be built again, and others with other voxels, heights or poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MappingError
from recon.core.geometry.se3 import invert
from recon.core.kernels import voxels
from recon.core.settings import Length, Settings
from recon.core.values import Frame, OccupancyVoxels, PointCloud, RayCloud, RayGrain
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.core.values.grid import log_odds
from recon.map.fusion import ALL, FusedPart, FusionSettings, columns_in, sums_in, sums_of
from recon.map.kernels import clamped, raycast
from recon.map.occupancy.part import OccupancyPart, SurfacePoints, sum_points

_MIN_SIGMA: Final = 0.2  # in voxels: more precise points count as this precise, no more
_MAX_SIGMA: Final = 6.0  # in voxels: less precise points are left out, they would smear


class CloudBuilder:
    """Fuses clouds frame by frame; a point weighs ``confidence / sigma²``.

    Time per frame grows with its points alone, memory with the number of voxels.
    """

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._known: tuple[str, ...] = ALL
        self._sums = voxels.make_sums(1, sums_in(ALL) - 4)
        self._frames = 0

    def __len__(self) -> int:
        """Return the number of voxels."""
        return int(self._sums.used[0])

    def integrate(self, cloud: PointCloud, doublings: UInt8 | None = None) -> None:
        """Add what one frame saw, in world axes; ``doublings`` are those of `voxel_doublings`.

        ``confidence`` None = 1, ``sigma_m`` None = all equally precise. What one of the clouds does
        not have, the map does not have.
        """
        _check_cloud(cloud, "world", "the fused map")
        limit_m = self._settings.voxel_m * (voxels.KEY_LIMIT - 1)
        if len(cloud) and np.abs(cloud.xyz).max() > limit_m:
            raise MappingError(
                "a point is too far from the origin for this voxel size",
                got=f"{np.abs(cloud.xyz).max():.0f} m",
                expected=f"at most {limit_m:.0f} m",
            )
        if len(cloud):  # forget what this cloud does not have
            known = tuple(name for name in self._known if name in cloud.arrays)
            self._sums = self._sums._replace(sums=sums_of(self._sums.sums, self._known, known))
            self._known = known
        doublings = np.zeros(0, np.uint8) if doublings is None else doublings
        weights = self._weights(cloud, doublings)
        points = voxels.VoxelPoints(cloud.xyz, weights, self._values(cloud), doublings)
        self._sums = voxels.add_points(self._sums, points, self._settings.voxel_m, self._frames)
        self._frames += 1

    def part(self) -> FusedPart:
        """Return what was seen since the start, or since the last `take`."""
        n, s, (keys, sums) = len(self), self._sums, voxels.copy_sums(self._sums)
        part = FusedPart(keys, sums, s.information[:n].copy(), s.frames[:n].copy(), self._known)
        return part if self._frames else part.knowing(())

    def take(self) -> FusedPart:
        """Return the part so far; the builder starts a new one."""
        part = self.part()
        self._sums, self._known, self._frames = voxels.make_sums(1, sums_in(ALL) - 4), ALL, 0
        return part

    def resume(self, part: FusedPart, frames: int) -> None:
        """Continue a part into which so many frames were integrated."""
        self._known, self._frames = part.known if frames else ALL, frames
        empty = voxels.make_sums(max(1, len(part)), sums_in(self._known) - 4)
        self._sums = voxels.add_rows(empty, part.keys, part.sums, part.information, part.frames)

    @property
    def nbytes(self) -> int:
        """Bytes of the voxels seen so far; the same after `resume` as before."""
        return len(self) * sum(array[:1].nbytes for array in self._sums[1:-1])

    def _weights(self, cloud: PointCloud, doublings: UInt8) -> Float32:
        """Return the weight of each point; 0 = not used. float32 (N,)."""
        confidence = np.float32(1) if cloud.confidence is None else cloud.confidence
        if cloud.sigma_m is None:
            return np.full(len(cloud), 1.0, np.float32) * confidence
        voxel_m = self._settings.voxel_m
        bounded = np.maximum(cloud.sigma_m, np.float32(_MIN_SIGMA * voxel_m))
        weights = confidence / bounded**2
        most_m = _MAX_SIGMA * voxel_m * (2.0**doublings if len(doublings) else 1.0)
        return np.where(cloud.sigma_m <= most_m, weights, 0).astype(np.float32)

    def _values(self, cloud: PointCloud) -> Float32:
        """Return what is averaged of each point, float32 (N, C); 0 = unknown."""
        values = np.zeros((len(cloud), sums_in(self._known) - 4), np.float32)
        columns, found = columns_in(self._known), dict(cloud.attributes)
        for each in columns.keys() & found.keys():
            values[:, columns[each].start - 4 : columns[each].stop - 4] = each.averaged(found[each])
        return values


_FIRST_POINTS: Final = 1 << 12
_LEAST_SIGMA_CELLS: Final = 0.1
"""Least standard deviation of a point, so that none outweighs all others in a mean."""
HIT_PROBABILITY: Final = 0.7
"""Occupancy of a voxel after one certain hit; OctoMap's, as the next three."""
MISS_PROBABILITY: Final = 0.4  # occupancy of a voxel after one ray went through it
MIN_PROBABILITY: Final = 0.12  # lower clamp: keeps the map able to change
MAX_PROBABILITY: Final = 0.97  # upper clamp
FREE_MARGIN_SIGMAS: Final = 2.0  # free space ends this many standard deviations before the point
SPREAD_SIGMAS: Final = 1.0  # voxels within this many standard deviations of the point share its hit
_MIN_POINTS: Final = 2  # voxels with fewer points in a frame start no ray


class OccupancySettings(Settings):
    """How clouds become occupancy."""

    resolution_m: float = Length(0.2, ge=1e-06, le=1000.0)
    """Edge of a voxel, and of a cell of the grid. Half of it takes about six times the memory."""
    max_range_m: float = Length(25.0, ge=1e-06, le=100000.0, reach=True)
    """Points farther away hit nothing, and so far from the path the ground is followed and the grid
    reaches. Less for short baselines, more for long ones."""
    keep_rays: bool = True
    """Keep the rays of every frame in the run's folder, for recon occupancy. Off saves 0.2 to 0.3
    MB per frame."""


class OccupancyBuilder:
    """Integrates clouds frame by frame into log-odds, in map axes (z up).

    The points of a frame are first reduced to one ray per voxel that they end in; then each voxel
    is updated at most once per frame, and a hit outweighs misses (OctoMap's rule).
    """

    def __init__(self, settings: OccupancySettings, T_map_world: NDArray[Any]) -> None:
        self._settings = settings
        self._T_map_world = np.asarray(T_map_world, dtype=np.float64)
        self._map = clamped.make_clamped(256)
        self._evidence = raycast.make_blocks(256)
        self._points = voxels.make_sums(_FIRST_POINTS, 1)

    def integrate(self, cloud: PointCloud, T_world_camera: NDArray[Any]) -> None:
        """Add what one frame saw from the pose ``T_world_camera`` of the camera.

        ``cloud`` is in camera axes; ``sigma_m`` None = exact, ``confidence`` None = 1, and
        ``count`` is the number of points that each stands for, None = 1.
        """
        _check_cloud(cloud, "camera", "the occupancy map")
        if not np.isfinite(T_world_camera).all():
            raise MappingError("a pose to map is not finite")
        away_m = float(np.abs(T_world_camera[:3, 3]).max())
        if away_m > (far_m := self._settings.resolution_m * (voxels.KEY_LIMIT / 2)):
            raise MappingError(
                "the camera is too far from the origin for this resolution",
                got=f"{away_m:.0f} m",
                expected=f"at most {far_m:.0f} m",
            )
        rays = frame_rays(cloud, self._T_map_world @ T_world_camera, self._settings)
        self._evidence = raycast.cast_rays(self._evidence, rays, SPREAD_SIGMAS)
        self._points = voxels.add_points(self._points, _hits(rays), 1.0, 0)
        low, high = log_odds(MIN_PROBABILITY), log_odds(MAX_PROBABILITY)
        self._map = clamped.add_evidence(self._map, self._evidence, low, high)

    def voxels(self) -> OccupancyVoxels:
        """Return every voxel that was observed so far, block by block as first touched."""
        return self.part().voxels(self._settings.resolution_m)

    def part(self) -> OccupancyPart:
        """Return what was observed since the start, or since the last `take`."""
        points = SurfacePoints(*voxels.copy_sums(self._points))
        return OccupancyPart(clamped.observed_rows(self._map), points)

    def take(self) -> OccupancyPart:
        """Return the part so far; the builder starts a new one."""
        part, self._map = self.part(), clamped.make_clamped(256)
        self._points = voxels.make_sums(_FIRST_POINTS, 1)
        return part

    def resume(self, part: OccupancyPart) -> None:
        """Continue a part that was taken from another builder."""
        self._map = clamped.chain_rows(clamped.make_clamped(256), part.rows)
        if part.points is not None:
            self._points = sum_points([part.points])

    @property
    def nbytes(self) -> int:
        """Bytes of the blocks and points so far; the same after `resume` as before."""
        points = int(self._points.used[0]) * sum(a[:1].nbytes for a in self._points[1:-1])
        return int(self._map.used[0]) * self._map.cells[:1].nbytes + points


def frame_rays(cloud: PointCloud, T_map_camera: Float64, s: OccupancySettings) -> raycast.Rays:
    """Return one ray per voxel in which enough points of a frame end; lengths in voxels."""
    T = T_map_camera.copy()
    T[:3] /= s.resolution_m
    ends, values = raycast.measure_points(
        cloud.xyz,
        *sigma_and_confidence(cloud),
        T,
        s.max_range_m / s.resolution_m,
        FREE_MARGIN_SIGMAS,
    )
    # Mean ends and values of each voxel with enough trusted points.
    weights = (values[:, 2] > 0).astype(np.float32)
    weights = weights if cloud.count is None else weights * cloud.count.astype(np.float32)
    points = voxels.VoxelPoints(ends, weights, values)
    sums = voxels.add_points(voxels.make_sums(4096, values.shape[1]), points, 1.0, 0)
    enough = np.flatnonzero(sums.sums[: sums.used[0], 0] >= _MIN_POINTS)
    found = sums.sums[enough, 1:] / sums.sums[enough, :1]
    means = voxels.unpack_keys(sums.keys[enough]) + 0.5 + found[:, :3]
    values = found[:, 3:]
    sigma, free, confidence, hit = np.ascontiguousarray(values.T)
    return raycast.Rays(
        origin=T[:3, 3].copy(),
        ends=means,
        free=free.astype(np.float64),
        sigma=sigma.astype(np.float64),
        hit=np.float32(log_odds(HIT_PROBABILITY)) * confidence * hit,
        miss=np.float32(log_odds(MISS_PROBABILITY)) * confidence,
    )


def _hits(rays: raycast.Rays) -> voxels.VoxelPoints:
    """Return the ends of the rays that hit something, precise ones with more weight."""
    hit = np.flatnonzero(rays.hit > 0)
    variances = rays.sigma[hit] ** 2 + _LEAST_SIGMA_CELLS**2
    weights, values = (1 / variances).astype(np.float32), variances[:, None].astype(np.float32)
    return voxels.VoxelPoints(rays.ends[hit], weights, values)


def sigma_and_confidence(cloud: PointCloud) -> tuple[Float32, Float32]:
    """Return both float32 (N,); 0 m and 1 where the cloud has none."""
    n = len(cloud)
    return (
        np.zeros(n, np.float32) if cloud.sigma_m is None else cloud.sigma_m,
        np.ones(n, np.float32) if cloud.confidence is None else cloud.confidence,
    )


def _check_cloud(cloud: PointCloud, frame: Frame, what: str) -> None:
    if cloud.frame != frame:
        raise MappingError(f"{what} takes clouds in {frame} axes", got=cloud.frame, expected=frame)
    if not all(np.isfinite(values).all() for values in cloud.arrays.values()):
        raise MappingError("a point to map is not finite")


_UNITS_PER_CELL: Final = 64
RAYS_PER_VOXEL: Final = 2
"""Points of a frame are averaged in cubes so many times finer than a voxel."""
_LARGEST: Final = np.iinfo(np.int16).max - 1
_FIRST_ROWS: Final = 1 << 15


def ray_grain(settings: OccupancySettings) -> RayGrain:
    """Return the resolution of the rays that are kept for a map."""
    cell_m = settings.resolution_m / RAYS_PER_VOXEL
    # The farthest places must fit into 16 bits.
    unit_m = max(cell_m / _UNITS_PER_CELL, (_beyond_m(settings) + cell_m) / _LARGEST)
    return RayGrain(cell_m, unit_m, settings.max_range_m)


def thin_rays(cloud: PointCloud, settings: OccupancySettings) -> RayCloud:
    """Average the measured points of a frame in cubes; those without confidence are dropped.

    A point out of the map's range is moved along its ray to just beyond it: it is still no hit, and
    frees the same space. ``cloud`` is as for `OccupancyBuilder.integrate`.
    """
    _check_cloud(cloud, "camera", "the occupancy map")
    cloud, grain = cloud.only_measured(), ray_grain(settings)
    sigma_m, sure = sigma_and_confidence(cloud)
    xyz, sigma_m = raycast.limit_points(
        cloud.xyz, sigma_m, settings.max_range_m, _beyond_m(settings), FREE_MARGIN_SIGMAS
    )
    points = voxels.VoxelPoints(
        xyz, (sure > 0).astype(np.float32), np.stack([sigma_m, sure], axis=1)
    )
    found = voxels.add_points(voxels.make_sums(_FIRST_ROWS, 2), points, grain.cell_m, 0)
    used = int(found.used[0])
    number = found.sums[:used, 0]
    mean = found.sums[:used, 1:] / number[:, None]
    places = (voxels.unpack_keys(found.keys[:used]) + 0.5) * grain.cell_m + mean[:, :3]
    return RayCloud(
        places=np.rint(places / grain.unit_m).astype(np.int16),
        sigma_m=mean[:, 3].astype(np.float16),
        confidence=np.clip(np.rint(255 * mean[:, 4]), 1, 255).astype(np.uint8),
        count=np.minimum(number, 255).astype(np.uint8),
        unit_m=grain.unit_m,
    )


def _beyond_m(settings: OccupancySettings) -> float:
    """Return where points out of range are moved to: never into a cube with one in range."""
    return settings.max_range_m + 2 * settings.resolution_m / RAYS_PER_VOXEL


class SubmapSettings(Settings):
    """Where a drive is divided into submaps, and into which tiles its map.

    Both bound the memory. Apart from rounding they change no result, except where a vehicle turned
    back and saw something on its own track: whether that came later is known by submaps.
    """

    length_m: float = Length(25.0, ge=1e-06, le=100_000.0)
    """Path after which a new submap begins. Shorter ones follow closed loops better and take
    less memory."""
    tile_m: float = Length(50.0, ge=1e-06, le=100_000.0)
    """Edge of the tiles, rounded to whole voxels. Smaller ones take less memory, and more time."""


@dataclass(frozen=True, eq=False)
class Submap:
    """What consecutive frames saw: ``fused`` in world axes, ``occupancy`` in map axes."""

    index: int
    first_frame: int
    frames: int
    fused: FusedPart
    occupancy: OccupancyPart

    def moved(
        self, T_corrected_world: Float64, T_map_world: Float64, voxel_m: float, resolution_m: float
    ) -> Submap:
        T_corrected_map = T_map_world @ T_corrected_world @ invert(T_map_world)
        return replace(
            self,
            fused=self.fused.moved(T_corrected_world, voxel_m),
            occupancy=self.occupancy.moved(T_corrected_map, resolution_m),
        )

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Submap:
        return cls(
            tree["index"],
            tree["first_frame"],
            tree["frames"],
            FusedPart.from_tree(tree["fused"]),
            OccupancyPart.from_tree(tree["occupancy"]),
        )
