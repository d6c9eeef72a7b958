"""From clouds in the world to one fused cloud: a voxel averages what all frames saw in it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from pydantic import Field

from recon.core.errors import MappingError
from recon.core.kernels import voxels
from recon.core.settings import Settings
from recon.core.values import PointCloud, RectifiedCamera
from recon.core.values.arrays import Float32
from recon.map.fusion.part import CONFIDENCE, KNOWABLE, NORMAL, RGB, VALUES, FusedPart

_MIN_SIGMA_M: Final = 0.02
"""Points more precise than this count as this precise: bounds the weight."""

_MAX_SIGMA_M: Final = 0.6
"""Points less precise than this are left out: they would smear over voxels."""

_NOMINAL_ERROR_PX: Final = 0.3
"""Error of a good match, by which the range of fusion is found."""


class FusionSettings(Settings):
    """How clouds are fused."""

    voxel_m: float = Field(
        0.1,
        ge=0.001,
        le=10.0,
        description="Edge of a voxel. Half of it takes about four times the memory; scale it with "
        "the scene.",
    )
    min_count: int = Field(
        3,
        ge=1,
        le=1000,
        description="Voxels seen by fewer frames are not exported, or by fewer than one less where "
        "they are precise. Lower it for slow or sparse drives, raise it where noise is left.",
    )
    max_depth_error_m: float | None = Field(
        0.25,
        ge=1e-6,
        le=100.0,
        description="Points are fused up to the depth at which a matching error of 0.3 px makes "
        "this error; none = all. Raise it to map farther and less precisely.",
    )
    remove_moving: bool = Field(
        default=True,
        description="Leave points of things that moved out of the cloud and the mesh: what was "
        "there as a whole at one time and gone at another, by the rays of single frames "
        "(occupancy.keep_rays). They are written to map/removed.ply.",
    )


def fusion_range_m(camera: RectifiedCamera, settings: FusionSettings) -> float:
    """Return the depth at which a matching error of 0.3 px costs ``max_depth_error_m``.

    The error of a depth grows with its square, ``Z²·error_px / (f·b)``: beyond this range a rig
    measures less precisely than the map requires. The setting fits short and long baselines.

    Args:
        camera: The rectified camera.
        settings: How to fuse.

    Returns:
        Metres; infinity where the settings have no limit.
    """
    if settings.max_depth_error_m is None:
        return math.inf
    fb = camera.focal_px * camera.baseline_m
    return math.sqrt(settings.max_depth_error_m * fb / _NOMINAL_ERROR_PX)


class CloudBuilder:
    """Fuses clouds frame by frame.

    A point weighs ``confidence / sigma²``. Time per frame grows with its points alone (on
    average: stores grow by doubling); memory with the number of voxels. The same clouds in the
    same order give the same map.

    Args:
        settings: How to fuse.
    """

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._sums = voxels.make_sums(1, VALUES)
        self._frames = 0
        self._known = dict.fromkeys(KNOWABLE, True)

    def __len__(self) -> int:
        """Return the number of voxels seen by at least one frame."""
        return int(self._sums.used[0])

    def integrate(self, cloud: PointCloud) -> None:
        """Add what one frame saw.

        Args:
            cloud: Points in world axes. ``confidence`` None = 1, ``sigma_m`` None = all equally
                precise. What one of the clouds does not have, the map does not have.
        """
        self._check(cloud)
        for name in self._known:
            self._known[name] &= getattr(cloud, name) is not None or len(cloud) == 0
        points = voxels.VoxelPoints(cloud.xyz, self._weights(cloud), _values(cloud))
        self._sums = voxels.add_points(self._sums, points, self._settings.voxel_m, self._frames)
        self._frames += 1

    def cloud(self, min_count: int | None = None) -> PointCloud:
        """Return the map so far, one point per voxel, in the order in which voxels were first seen.

        Args:
            min_count: Voxels seen by fewer frames are left out, or by fewer than one less where
                they are precise; None = as in the settings.

        Returns:
            As `FusedPart.cloud` gives it.
        """
        s = self._settings
        return self.part().cloud(s.voxel_m, min_count or s.min_count)

    def part(self) -> FusedPart:
        """Return what was seen since the start, or since the last `take`."""
        n, s = len(self), self._sums
        known = tuple(name for name, value in self._known.items() if value)
        return FusedPart(
            s.keys[:n].copy(),
            s.sums[:n].copy(),
            s.information[:n].copy(),
            s.frames[:n].copy(),
            known if self._frames else (),
        )

    def take(self) -> FusedPart:
        """Return the part so far; the builder starts a new one."""
        part = self.part()
        self._sums = voxels.make_sums(1, VALUES)
        self._known, self._frames = dict.fromkeys(self._known, True), 0
        return part

    def resume(self, part: FusedPart, frames: int) -> None:
        """Continue a part that was taken from another builder.

        Args:
            part: The part.
            frames: Number of frames that were integrated into it.
        """
        empty = voxels.make_sums(max(1, len(part)), VALUES)
        self._sums = voxels.add_rows(empty, part.keys, part.sums, part.information, part.frames)
        self._known = {name: name in part.known or frames == 0 for name in self._known}
        self._frames = frames

    @property
    def nbytes(self) -> int:
        """Bytes of the voxels seen so far; the same after `resume` as before."""
        return len(self) * sum(array[:1].nbytes for array in self._sums[1:-1])

    def _weights(self, cloud: PointCloud) -> Float32:
        """Return the weight of each point; 0 = not used. float32 (N,)."""
        confidence = np.float32(1) if cloud.confidence is None else cloud.confidence
        if cloud.sigma_m is None:
            return np.full(len(cloud), 1.0, np.float32) * confidence
        bounded = np.maximum(cloud.sigma_m, np.float32(_MIN_SIGMA_M))
        weights = confidence / bounded**2
        return np.where(cloud.sigma_m <= _MAX_SIGMA_M, weights, 0).astype(np.float32)

    def _check(self, cloud: PointCloud) -> None:
        """Refuse what would silently spoil the map."""
        if cloud.frame != "world":
            raise MappingError(
                "the fused map takes clouds in world axes", got=cloud.frame, expected="world"
            )
        limit_m = self._settings.voxel_m * (voxels.KEY_LIMIT - 1)
        numbers = (cloud.xyz, cloud.sigma_m, cloud.confidence, cloud.normals)
        if not all(a is None or np.isfinite(a).all() for a in numbers):
            raise MappingError("a point to map is not finite")
        if len(cloud) and np.abs(cloud.xyz).max() > limit_m:
            raise MappingError(
                "a point is too far from the origin for this voxel size",
                got=f"{np.abs(cloud.xyz).max():.0f} m",
                expected=f"at most {limit_m:.0f} m",
            )


def _values(cloud: PointCloud) -> Float32:
    """Return what is averaged of each point, (N, 7): colour, normal, confidence; 0 = unknown."""
    values = np.zeros((len(cloud), VALUES), np.float32)
    for columns, array in (
        (RGB, cloud.rgb),
        (NORMAL, cloud.normals),
        (CONFIDENCE, cloud.confidence),
    ):
        if array is not None:
            values[:, columns] = array
    return values
