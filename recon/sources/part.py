"""A part of a drive, as a drive of its own."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

from recon.core.values import StereoPair
from recon.sources.protocol import DerivedSource, StereoSource


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
