"""The base class of all sources of stereo pairs, of recordings, and of what is made of a source."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

from recon.core.errors import SourceError
from recon.core.text import counted
from recon.core.values import OccupancyTruth, Rig, SequenceTruth, StereoPair, Trajectory
from recon.core.values.arrays import Float64
from recon.io.trajectory import read_tum
from recon.sources.frame_list import FrameList


@dataclass(frozen=True, eq=False)
class ReadPrior:
    """A path by other sensors, on the clock of the images; ``origin`` says in one line whose."""

    path: Trajectory
    origin: str


class StereoSource(ABC):
    """An ordered sequence of stereo pairs from one rig, read lazily.

    The base of every source, also of those of users: a subclass has a `calibration`, ``len()`` and
    `frames`; the rest has defaults. What is a property here may be a plain attribute there.
    """

    live: bool = False
    """Whether pairs arrive in their own time: poses come first, and what is late is left out."""
    lead: int = 0
    """Pairs at the start that only lead the odometry, and are not put into the map."""

    @cached_property
    def name(self) -> str:
        """Name for the user: the folder or device."""
        return type(self).__name__

    @cached_property
    def description(self) -> str:
        """The recognised kind and how it is read, in one line for the user."""
        return "a source"

    @cached_property
    @abstractmethod
    def calibration(self) -> Rig:
        """A `RectifiedCamera` if the images are already rectified."""
        raise NotImplementedError

    @cached_property
    def files(self) -> Sequence[Path]:
        """The files that pairs and calibration are read from, for the record of a run."""
        return ()

    @cached_property
    def truth(self) -> SequenceTruth | None:
        """Ground truth of the trajectory and surface, as far as known."""
        return None

    @cached_property
    def stamps_s(self) -> Float64 | None:
        """float64 (N,), seconds, times of all pairs; None = only reading them tells."""
        return None

    @cached_property
    def left_out(self) -> int:
        """Number of images without a partner."""
        return 0

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of pairs."""

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs in order, one in memory at a time, from pair ``start`` on.

        Earlier pairs are skipped as cheaply as the input allows: image files are not read, a bag
        is entered by its index, a video is decoded up to there.

        Raises:
            FormatError: An image is missing or truncated.
            CalibrationError: An image has another size than the calibration.
        """

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name}, pairs: {len(self)}, {self.description})"

    def lines(self, count: int) -> list[int] | None:
        """Return the line of each pair, from 0, in a file of ``count`` lines, one per frame.

        None = the file has too few lines.
        """
        return list(range(len(self))) if count >= len(self) else None

    def shift_of(self, pairs: int) -> int | None:
        """Return ``source.shift_frames`` with right images of so many pairs later than now.

        None = the source does not have this setting.
        """
        return None

    def read_prior(self, name: str) -> ReadPrior:
        """Read the motion by other sensors: a TUM file, or what else this kind of source has."""
        return ReadPrior(read_tum(name), name)

    def occupancy_truth(
        self,
        *,
        resolution_m: float,
        band_m: tuple[float, float],
        range_m: float,
        least_frames: int,
        T_map_world: Float64 | None,
    ) -> OccupancyTruth | None:
        """Return true obstacles, and which the drive saw, in the cells and axes of a map."""
        return None

    def warnings(self) -> list[str]:
        """Return what the user should know of a drive that was read, in words."""
        return []

    def figures(self) -> dict[str, Any]:
        """Return the same for ``summary.json``."""
        return {}

    def hurried(self) -> bool:
        """Return whether the next pair has arrived already, so that this one is late."""
        return False

    def note_located(self, index: int) -> None:  # noqa: B027 - only live sources care
        """Note that the pose of pair ``index`` of those yielded is known."""

    def note_unmatched(self) -> None:  # noqa: B027
        """Note that there is no time to match a pair that was yielded."""


def check_source(source: object) -> None:
    """Refuse what is not a `StereoSource`, such as a path."""
    if not isinstance(source, StereoSource):
        raise SourceError(
            "not a source of stereo pairs",
            got=type(source).__name__,
            expected="what recon.open_source returns, or a subclass of recon.StereoSource",
        )


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Recording(StereoSource):
    """A recorded drive, of which frames may lack a partner."""

    name: str
    description: str
    calibration: Rig
    listing: FrameList  # which frames of the recording are pairs
    texts: tuple[Path, ...]  # calibration and other text files that were read
    truth: SequenceTruth | None = None

    @cached_property
    def left_out(self) -> int:
        """Number of images without a partner."""
        return sum(self.listing.alone)

    def __len__(self) -> int:
        return len(self.listing.kept)

    def lines(self, count: int) -> list[int] | None:
        """Return the line of each pair in a file with one line per frame; see `FrameList.lines`."""
        return self.listing.lines(count)

    def shift_of(self, pairs: int) -> int:
        """Return ``source.shift_frames`` with right images of so many pairs later than now."""
        chosen = self.listing.chosen
        return self.listing.shift + pairs * (1 if chosen is None else chosen.step)

    def warnings(self) -> list[str]:
        """Return how many images were left out, in words."""
        out = self.left_out
        return [f"{counted(out, 'image')} without a partner: left out"] if out else []

    def figures(self) -> dict[str, Any]:
        """Return how many images were left out."""
        return {"frames_left_out": self.left_out}


class DerivedSource(StereoSource):
    """A source made of another one, with its name, calibration and files, but without its truth."""

    name: str
    description: str
    calibration: Rig
    files: Sequence[Path]

    def __init__(self, source: StereoSource) -> None:
        check_source(source)
        self.source, self.name, self.description = source, source.name, source.description
        self.calibration, self.files = source.calibration, source.files


class SourcePart(DerivedSource):
    """The pairs of a source from ``first`` on, up to but not including ``last``.

    Of these the first ``lead`` belong to the part before: they only lead the odometry.
    """

    def __init__(self, source: StereoSource, first: int, last: int, lead: int = 0) -> None:
        super().__init__(source)
        self.first, self.last, self.lead = first, last, lead
        self.name = f"{source.name} {first} to {last - 1}"

    def __len__(self) -> int:
        return self.last - self.first

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs from number ``start`` of the part on."""
        return islice(self.source.frames(self.first + start), len(self) - start)
