"""The interfaces of sources of stereo pairs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Protocol, runtime_checkable

from recon.core.values import (
    OccupancyTruth,
    Rig,
    SequenceTruth,
    StereoPair,
)
from recon.core.values.arrays import Float64
from recon.sources.frame_list import FrameList


@runtime_checkable
class StereoSource(Protocol):
    """An ordered sequence of stereo pairs from one rig, read lazily."""

    @property
    def name(self) -> str:
        """Name for the user: the folder or device."""
        ...

    @property
    def description(self) -> str:
        """The recognised kind and how it is read, in one line for the user."""
        ...

    @property
    def calibration(self) -> Rig:
        """A `RectifiedCamera` if the images are already rectified."""
        ...

    @property
    def truth(self) -> SequenceTruth | None:
        """Ground truth of the trajectory and surface, as far as known, or None."""
        ...

    @property
    def files(self) -> Sequence[Path]:
        """The files that pairs and calibration are read from, for the record of a run."""
        ...

    def __len__(self) -> int:
        """Return the number of pairs."""
        ...

    def __iter__(self) -> Iterator[StereoPair]:
        """Yield all pairs, like ``frames()``."""
        ...

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs in order, one in memory at a time, from pair ``start`` on.

        Earlier pairs are skipped as cheaply as the input allows: image files are not read, a bag
        is entered by its index, a video is decoded up to there.

        Raises:
            FormatError: An image is missing or truncated.
            CalibrationError: An image has another size than the calibration.
        """
        ...


def source_text(source: StereoSource) -> str:
    """Return a source in one short line, for its ``repr``."""
    return f"{type(source).__name__}({source.name}, pairs: {len(source)}, {source.description})"


class DerivedSource(ABC):
    """A source made of another one, with its name, calibration and files, but without its truth.

    Args:
        source: The other one.
    """

    truth = None

    def __init__(self, source: StereoSource) -> None:
        self.source = source

    @property
    def name(self) -> str:
        """That of the source."""
        return self.source.name

    @property
    def description(self) -> str:
        """That of the source."""
        return self.source.description

    @property
    def calibration(self) -> Rig:
        """That of the source."""
        return self.source.calibration

    @property
    def files(self) -> Sequence[Path]:
        """Those of the source."""
        return self.source.files

    def __repr__(self) -> str:
        return source_text(self)

    def __iter__(self) -> Iterator[StereoPair]:
        """Yield all pairs, like ``frames()``."""
        return self.frames()

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of pairs."""

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs from number ``start`` on."""


@runtime_checkable
class KnowsOccupancy(Protocol):
    """A source with ground truth of the occupancy."""

    def occupancy_truth(
        self,
        *,
        resolution_m: float,
        band_m: tuple[float, float],
        range_m: float,
        least_frames: int,
        T_map_world: Float64 | None,
    ) -> OccupancyTruth:
        """Return true obstacles, and which the drive saw, in the cells and axes of a map."""
        ...


@runtime_checkable
class StampedSource(Protocol):
    """A source that knows the times of all pairs without reading them."""

    @property
    def stamps_s(self) -> Float64:
        """float64 (N,), seconds, one for each pair."""
        ...


@runtime_checkable
class IncompleteSource(Protocol):
    """A source that may leave out frames of its recording."""

    @property
    def left_out(self) -> int:
        """Number of images without a partner."""
        ...

    def lines(self, count: int) -> list[int] | None:
        """Return the line of each pair in a file of ``count`` lines with one line per frame.

        Returns:
            Indices from 0; None = the file has too few lines.
        """
        ...

    def shift_of(self, pairs: int) -> int:
        """Return ``source.shift_frames`` with right images of so many pairs later than now."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording(ABC):
    """A recorded drive, of which frames may lack a partner.

    Attributes:
        name: Name of the file or folder.
        description: Recognised kind and how it is read, in one line.
        calibration: The rectified camera, or the two raw ones.
        listing: Which frames of the recording are pairs.
        texts: Calibration and other text files that were read.
        truth: Ground truth trajectory, if known.
    """

    name: str
    description: str
    calibration: Rig
    listing: FrameList
    texts: tuple[Path, ...]
    truth: SequenceTruth | None = None

    @property
    def left_out(self) -> int:
        """Number of images without a partner."""
        return sum(self.listing.alone)

    def lines(self, count: int) -> list[int] | None:
        """Return the line of each pair in a file with one line per frame; see `FrameList.lines`."""
        return self.listing.lines(count)

    def shift_of(self, pairs: int) -> int:
        """Return ``source.shift_frames`` with right images of so many pairs later than now."""
        chosen = self.listing.chosen
        return self.listing.shift + pairs * (1 if chosen is None else chosen.step)

    @property
    @abstractmethod
    def files(self) -> Sequence[Path]:
        """The files that pairs and calibration are read from."""

    def __repr__(self) -> str:
        return source_text(self)

    def __len__(self) -> int:
        return len(self.listing.kept)

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Read the pairs from number ``start`` on."""


class SourcePart(DerivedSource):
    """Consecutive pairs of a source.

    Args:
        source: The source.
        first: Its pair that is the first of the part.
        last: Its pair behind the last one of the part.
        lead: Pairs at the start that only lead the odometry: they belong to the part before, and
            nothing of them is put into the map.
    """

    def __init__(self, source: StereoSource, first: int, last: int, lead: int = 0) -> None:
        super().__init__(source)
        self.first, self.last, self.lead = first, last, lead

    @property
    def name(self) -> str:
        """That of the source, and which pairs."""
        return f"{self.source.name} {self.first} to {self.last - 1}"

    def __len__(self) -> int:
        return self.last - self.first

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs from number ``start`` of the part on."""
        return islice(self.source.frames(self.first + start), len(self) - start)
