"""The frames of a recording: which of them are pairs, and which of the pairs are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

from recon.core.errors import SourceError
from recon.core.text import counted, is_count
from recon.sources.settings import SourceSettings

Item = TypeVar("Item")
Left = TypeVar("Left")
Right = TypeVar("Right")

_ONE_RATE: Final = 2 / 3
"""Share of the frames that have both images, from which two cameras have one rate."""


@dataclass(frozen=True)
class FrameList:
    """Which frames of a recording are pairs."""

    # Names without suffix of all frames in order, also of those without a partner; empty names
    # where there are none
    names: Sequence[str]
    paired: Sequence[int]  # positions of the pairs among them
    # Numbers of left and right images without a partner, which are left out
    alone: tuple[int, int] = (0, 0)
    chosen: range | None = None  # which of the pairs are used; None = all
    shift: int = 0  # by how many frames the right images were taken later than the left ones

    def __str__(self) -> str:
        text = (
            f", right images {counted(self.shift, 'frame', form='+d')} later" if self.shift else ""
        )
        if any(self.alone):
            text += f", {self.alone[0]} left and {self.alone[1]} right without a partner left out"
        if self.chosen is None:
            return text
        every = f" in steps of {self.chosen.step}" if self.chosen.step > 1 else ""
        return f"{text}, frames {self.chosen[0]} to {self.chosen[-1]}{every}"

    @property
    def kept(self) -> Sequence[int]:
        """Positions of the pairs that are used."""
        return self.used(self.paired)

    def used(self, of_pairs: Sequence[Item]) -> list[Item]:
        """Return what belongs to the pairs that are used, of what belongs to all pairs."""
        return list(of_pairs) if self.chosen is None else [of_pairs[k] for k in self.chosen]

    def choose(self, settings: SourceSettings, where: Path) -> FrameList:
        """Return the same recording, of which the frames that the settings choose are used."""
        if (settings.start, settings.end, settings.stride) == (0, None, 1):
            return self
        chosen = range(len(self.paired))[settings.start : settings.end : settings.stride]
        if not chosen:
            raise SourceError(
                "no frame is chosen",
                where=where,
                got=f"from {settings.start} to before {settings.end or len(self.paired)}",
                expected=f"frames from 0 to {len(self.paired) - 1}",
                hint="see --start and --end",
            )
        return replace(self, chosen=chosen)

    def lines(self, count: int) -> list[int] | None:
        """Return the line of each pair, from 0, in a file of one line per frame (``times.txt``).

        One line per pair fits at once, whether of all pairs or of those used. Else names that are
        counters give the line, so that it stays the right one where images are missing; else the
        position does, and further lines are ignored.

        None = the file has too few lines.
        """
        of_pairs = self._lines_of_all(count)
        if of_pairs is None:
            return list(range(count)) if count == len(self.kept) else None
        return self.used(of_pairs)

    def _lines_of_all(self, count: int) -> list[int] | None:
        if count == len(self.paired):
            return list(range(count))
        names = [self.names[k] for k in self.paired]
        numbers = [int(name) if is_count(name) else count for name in names]
        if max(numbers) < count:
            return numbers
        return list(self.paired) if len(self.names) <= count else None


def pair_frames(
    frames: Sequence[tuple[Left | None, Right | None]],
    settings: SourceSettings,
    where: Path,
    names: Sequence[str] | None = None,
) -> tuple[list[tuple[Left, Right]], FrameList]:
    """Return the pairs that are used, of frames in order with a left and right image (or None).

    The settings say by how many frames the right images were taken later. ``names`` are those of
    the frames without suffix.
    """
    alone_right = sum(left is None and right is not None for left, right in frames)
    # A listed frame without any image counts as one, on the left.
    alone_left = sum(right is None for _, right in frames)
    pairs, places = [], []
    for place, (left, right) in enumerate(_shift_right(frames, settings.shift_frames, where)):
        if left is not None and right is not None:
            pairs.append((left, right))
            places.append(place)
    listing = FrameList(
        names=[""] * len(frames) if names is None else names,
        paired=places,
        alone=(alone_left, alone_right),
        shift=settings.shift_frames,
    ).choose(settings, where)
    return listing.used(pairs), listing


def _shift_right(
    frames: Sequence[tuple[Left | None, Right | None]], by: int, where: Path
) -> Sequence[tuple[Left | None, Right | None]]:
    """Return the frames with the right images of so many frames later."""
    if not by:
        return frames
    whole = [k for k, (left, right) in enumerate(frames) if left is not None and right is not None]
    # Where cameras have different rates, only the frames of the slower one count.
    chosen = whole if len(whole) < _ONE_RATE * len(frames) else range(len(frames))
    rights: list[Right | None] = [None] * len(frames)
    for k, later in zip(chosen[max(0, -by) :], chosen[max(0, by) :], strict=False):
        rights[k] = frames[later][1]
    shifted = [(left, right) for (left, _), right in zip(frames, rights, strict=True)]
    if all(left is None or right is None for left, right in shifted):
        raise SourceError(
            "no pair is left with right images that were taken later",
            where=where,
            got=f"source.shift_frames={by}, {counted(len(chosen), 'frame')}",
            expected="fewer frames than the recording has, or 0",
        )
    return shifted


def check_most(pairs: int, images: int, where: Path) -> None:
    """Refuse a recording of which most is missing; ``images`` of one camera, found or listed."""
    if 2 * pairs < images:
        raise SourceError(
            "most images have no partner",
            where=where,
            got=f"{counted(pairs, 'pair')} of {counted(images, 'image')}",
            hint="give both images of a pair the same name or time, and copy missing files again",
        )
