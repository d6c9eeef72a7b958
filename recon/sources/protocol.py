"""What every source of stereo pairs promises."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from recon.structures import (
    OccupancyTruth,
    RectifiedCamera,
    SequenceTruth,
    StereoCalibration,
    StereoPair,
)
from recon.structures.arrays import Float64


@runtime_checkable
class StereoSource(Protocol):
    """An ordered series of stereo pairs from one rig, read lazily."""

    @property
    def name(self) -> str:
        """What a user calls it: the folder or device."""
        ...

    @property
    def description(self) -> str:
        """What it was taken for and how it was read, in one line for the user."""
        ...

    @property
    def calibration(self) -> RectifiedCamera | StereoCalibration:
        """A `RectifiedCamera` where the pictures are already rectified."""
        ...

    @property
    def truth(self) -> SequenceTruth | None:
        """What is known of the true path and surface, or None."""
        ...

    @property
    def files(self) -> Sequence[Path]:
        """The files that its pairs and its calibration are read from, for the record of a run."""
        ...

    def __len__(self) -> int:
        """Number of pairs."""
        ...

    def __iter__(self) -> Iterator[StereoPair]:
        """Yield all pairs, as ``frames()``."""
        ...

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs in order, one in memory at a time, from pair ``start`` on.

        The pairs before ``start`` are skipped as cheaply as the input allows: pictures are not
        read, a bag is entered by its index, a video is decoded up to there.

        Raises:
            FormatError: A picture is missing, truncated or of another size.
        """
        ...


@runtime_checkable
class KnowsOccupancy(Protocol):
    """A source that knows what is really occupied."""

    def occupancy_truth(
        self,
        *,
        resolution_m: float,
        band_m: tuple[float, float],
        range_m: float,
        least_frames: int,
        T_map_world: Float64 | None,
    ) -> OccupancyTruth:
        """Where obstacles stand, and what of it the drive saw, in the cells and axes of a map."""
        ...


@runtime_checkable
class StampedSource(Protocol):
    """A source that knows the times of all pairs without reading one."""

    @property
    def stamps_s(self) -> Float64:
        """float64 (N,), seconds, one for each pair."""
        ...
