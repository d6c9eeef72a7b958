"""What every source of stereo pairs promises."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from recon.structures import RectifiedCamera, SequenceTruth, StereoCalibration, StereoPair


@runtime_checkable
class StereoSource(Protocol):
    """An ordered series of stereo pairs from one rig, read lazily."""

    @property
    def name(self) -> str:
        """What a user calls it: the folder or device."""
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
        """Yield the pairs in order, one in memory at a time.

        Raises:
            FormatError: A picture is missing, truncated or of another size.
        """
        ...
