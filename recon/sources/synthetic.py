"""The synthetic street drive as a source."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

from recon.core.values import (
    DisparityTruth,
    OccupancyTruth,
    RectifiedCamera,
    SequenceTruth,
    StereoPair,
    Trajectory,
)
from recon.core.values.arrays import Float64
from recon.sources.source import StereoSource
from recon.street.render import StreetCamera, SyntheticFrame
from recon.street.settings import StreetSettings
from recon.street.street import StreetWorld, build_street
from recon.street.truth import true_occupancy, true_surface


class SyntheticSource(StereoSource):
    """A rendered drive through a synthetic street, with complete ground truth."""

    name: str
    description = "a rendered street"

    def __init__(
        self, settings: StreetSettings | None = None, *, surface_range_m: float = 30.0
    ) -> None:
        self.settings = StreetSettings() if settings is None else settings
        self._surface_range_m = surface_range_m
        self.name = f"synthetic street {self.settings.seed}"

    @cached_property
    def world(self) -> StreetWorld:
        return build_street(self.settings)

    @cached_property
    def camera(self) -> StreetCamera:
        """The rig in the street, which renders any frame with its ground truth."""
        return StreetCamera(self.world)

    @cached_property
    def calibration(self) -> RectifiedCamera:
        return self.world.camera

    @property
    def trajectory(self) -> Trajectory:
        """True poses; cheap, unlike `truth`."""
        return self.world.trajectory

    @cached_property
    def truth(self) -> SequenceTruth:
        """True poses, and the surfaces seen within the range, sampled every 5 cm."""
        surface = true_surface(self.camera, range_m=self._surface_range_m)
        return SequenceTruth(self.trajectory, surface)

    def __len__(self) -> int:
        return self.settings.frames

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        return (self.camera.pair(index) for index in range(start, len(self)))

    def frame(self, index: int) -> SyntheticFrame:
        """Return one pair with depth, disparity, pose and ground, or raise a `SettingsError`."""
        return self.camera.render(index)

    def disparity_truth(self, index: int) -> DisparityTruth:
        """Return the true disparity of a frame, NaN = sky, or raise a `SettingsError`."""
        return self.camera.disparity_truth(index)

    def occupancy_truth(
        self,
        *,
        resolution_m: float = 0.2,
        band_m: tuple[float, float] = (0.3, 2.0),
        range_m: float = 25.0,
        least_frames: int = 3,
        T_map_world: Float64 | None = None,
    ) -> OccupancyTruth:
        return true_occupancy(
            self.camera,
            resolution_m=resolution_m,
            band_m=band_m,
            range_m=range_m,
            least_frames=least_frames,
            T_map_world=T_map_world,
        )
