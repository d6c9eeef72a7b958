"""Settings of a drive: what determines its map."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.errors import MemoryLimitError
from recon.core.machine import peak_memory_mb, return_free_memory
from recon.core.settings import Length, Settings, doublings_at
from recon.core.values import PointCloud
from recon.map.builders import OccupancySettings, SubmapSettings
from recon.map.fusion import FusionSettings
from recon.map.ground.axes import AxesSettings
from recon.map.ground.grid import GridSettings
from recon.map.ground.surface import GroundSettings
from recon.map.ground.traverse import RobotSettings
from recon.map.kernels.raycast import BLOCK_EDGE
from recon.odometry.protocol import Odometry
from recon.odometry.registry import check_odometry
from recon.odometry.settings import OdometrySettings, RigSettings
from recon.stereo.frame import StereoSettings

#: Fractions of the limit for an open submap, the cells of one tile, and what was read from the map.
#: Sums grow by doubling and are copied when closed, so each briefly costs several times its size;
#: most of the limit is left to the libraries, the images and the matcher.
_SUBMAP_RATIO: Final = 1 / 40
_TILE_RATIO: Final = 1 / 24
_CACHE_RATIO: Final = 1 / 10
_CACHE_BYTES: Final = 100_000_000


class MemorySettings(Settings):
    """How much memory a run may take."""

    limit_mb: float | None = Field(None, ge=1.0, le=1_000_000_000.0)
    """Largest resident memory of the process, in 10⁶ bytes; none = no limit. Submaps and tiles are
    made smaller to meet it, so results may differ by rounding."""

    @property
    def submap_bytes(self) -> int | None:
        """Size at which a submap is closed; None = closed by the path alone."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _SUBMAP_RATIO)

    @property
    def tile_bytes(self) -> int | None:
        """Largest size of a tile's cells before they are merged; None = unlimited."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _TILE_RATIO)

    @property
    def cache_bytes(self) -> int:
        """Most that is kept in memory of what was read from a map."""
        return _CACHE_BYTES if self.limit_mb is None else int(1e6 * self.limit_mb * _CACHE_RATIO)

    def check(self, where: str) -> None:
        """Stop a run that exceeds the limit; else return what is free, for what comes next."""
        if self.limit_mb is None:
            return
        if peak_memory_mb() > self.limit_mb:
            raise MemoryLimitError(
                "the memory limit cannot be kept",
                where=where,
                got=f"{peak_memory_mb():.0f} MB",
                expected=f"at most {self.limit_mb:g} MB",
                hint="give more with --memory-limit, or take smaller images, fewer disparities "
                "or a coarser map",
            )
        return_free_memory()


SCALES: Final = (1e-5, 1e3)


class SceneSettings(Settings):
    """How large what the cameras see is."""

    scale: float | None = Field(None, ge=SCALES[0], le=SCALES[1])
    """Size of the scene against a road: lengths whose default is marked ``× scale`` are that
    times this unless they are set. none = by the depth of what the drive shows; a room has about
    0.2. Give two drives that are to share a map the same."""


class MapFilterSettings(Settings):
    """What is dropped from the fused cloud."""

    radius_m: float | None = Length(0.3, ge=1e-06, le=1000000.0)
    """Points with fewer than two others within this radius are dropped. About three voxels; larger
    drops larger islands; none = keep all."""


class CheckpointSettings(Settings):
    """How often the map is committed while a drive is mapped; does not change results."""

    every_frames: int = Field(50, ge=1, le=1_000_000)
    """Number of frames between two checkpoints."""


class LoopSettings(Settings):
    """Loop closure: recognising a place, verifying it and correcting the path."""

    enabled: bool = True
    """Look for loops and close them. Turn it off where the path has none, for speed."""


class DriveSettings(StereoSettings):
    """Everything that determines the map of a drive."""

    scene: SceneSettings = SceneSettings()
    map_filters: MapFilterSettings = MapFilterSettings()
    rig: RigSettings = RigSettings()
    odometry: OdometrySettings = OdometrySettings()
    loops: LoopSettings = LoopSettings()
    axes: AxesSettings = AxesSettings()
    fusion: FusionSettings = FusionSettings()
    occupancy: OccupancySettings = OccupancySettings()
    submaps: SubmapSettings = SubmapSettings()
    checkpoints: CheckpointSettings = CheckpointSettings()
    memory: MemorySettings = MemorySettings()
    ground: GroundSettings = GroundSettings()
    grid: GridSettings = GridSettings()
    robot: RobotSettings = RobotSettings()

    @property
    def scale(self) -> float:
        """Size of the scene against a road."""
        return self.scene.scale or 1.0

    def island_radii_m(self, cloud: PointCloud) -> float | NDArray[Any] | None:
        """Return the radius in which points need neighbours; uncertain ones, in coarser voxels.

        None = in none; (N,) = of each point.
        """
        radius_m, doublings = self.map_filters.radius_m, self.fusion.doublings
        if radius_m is None or not doublings or cloud.sigma_m is None or cloud.count is None:
            return radius_m
        frame_sigma = cloud.sigma_m * np.sqrt(cloud.count) / self.fusion.voxel_m
        return np.asarray(radius_m * 2.0 ** np.clip(np.ceil(np.log2(frame_sigma)), 0, doublings))

    def with_odometry(self, odometry: str | Odometry) -> Self:
        """Return the settings with another odometry, by name or as an object.

        ``config.yaml`` has the name of an object only, so such a run is repeated from Python.
        """
        check_odometry(odometry)
        chosen = self.odometry.model_copy(update={"method": odometry})
        return self.model_copy(update={"odometry": chosen})

    def at_scale(self, scale: float) -> Self:
        """Return the settings with lengths that follow from a scale, unless another one is set."""
        scale = self.scene.scale or scale
        scene = SceneSettings(scale=scale)
        fitted = super().at_scale(scale).model_copy(update={"scene": scene})
        if fitted.fusion.doublings is None:
            update = {"doublings": doublings_at(scale)}
            fusion = fitted.fusion.model_copy(update=update)
            fitted = fitted.model_copy(update={"fusion": fusion})
        return self.parse(dict(fitted))  # again: what is set may not go with what follows

    @model_validator(mode="after")
    def _check_margins(self) -> Self:
        """Refuse margins wider than a tile: each tile would be made of all those around it."""
        tile_m = max(self.submaps.tile_m, BLOCK_EDGE * self.occupancy.resolution_m)
        reach_m = self.map_filters.radius_m or 0.0
        if reach_m > tile_m:
            raise ValueError(
                f"map_filters.radius_m reaches {reach_m:g} m, beyond a tile of {tile_m:g} m "
                "(submaps.tile_m)"
            )
        return self
