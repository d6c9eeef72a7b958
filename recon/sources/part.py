"""A part of a drive, as a drive of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from recon.core.values import Rig, StereoPair
from recon.sources.protocol import StereoSource


@dataclass(frozen=True, eq=False)
class SourcePart:
    """Consecutive pairs of a source, without its ground truth.

    Attributes:
        source: The source.
        first: Its pair that is the first of the part.
        last: Its pair behind the last one of the part.
        lead: Pairs at the start that only lead the odometry: they belong to the part before, and
            nothing of them is put into the map.
    """

    source: StereoSource
    first: int
    last: int
    lead: int = 0

    truth = None

    @property
    def name(self) -> str:
        """That of the source, and which pairs."""
        return f"{self.source.name} {self.first} to {self.last - 1}"

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

    def __len__(self) -> int:
        return self.last - self.first

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs from number ``start`` of the part on."""
        return islice(self.source.frames(self.first + start), len(self) - start)
