"""Pairs left and right images by name or by timestamp."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.geometry.interpolation import nearest_sorted
from recon.core.values.arrays import Float64
from recon.sources.settings import SourceSettings

# Parts of names that mark the left camera, each with its counterpart for the right one.
SIDES: Final = (
    ("left", "right"),
    ("Left", "Right"),
    ("LEFT", "RIGHT"),
    ("cam0", "cam1"),
    ("cam_0", "cam_1"),
    ("camera0", "camera1"),
    ("camera_0", "camera_1"),
    ("infra1", "infra2"),
    ("image_0", "image_1"),
    ("image_2", "image_3"),
    ("view1", "view5"),
    ("im0", "im1"),
    ("l", "r"),
    ("L", "R"),
    ("0", "1"),
)
_DIGITS: Final = re.compile(r"([0-9]+)")
_STAMP: Final = re.compile(r"\d{10}(\.\d+)?|\d{13}|\d{16}|\d{19}|\d+\.\d+", re.ASCII)

_SECONDS_DIGITS: Final = 10
"""Digits of a time in seconds since 1970, from 2001 to 2286."""
_CLOCK_STEPS: Final = 10
"""Least step of padded numbers that are a clock: 10 ms, or less in finer units."""


@dataclass(frozen=True, eq=False)
class StampPairs:
    """Pairs of entries of two series of timestamps.

    Attributes:
        left: Indices into the left series, increasing.
        right: Indices of their partners in the right series, increasing.
        alone: Numbers of entries (left, right) without a partner.
    """

    left: Sequence[int]
    right: Sequence[int]
    alone: tuple[int, int]

    def chosen(self, which: range | None) -> StampPairs:
        """Return some of the pairs; None = all."""
        if which is None:
            return self
        left, right = ([side[k] for k in which] for side in (self.left, self.right))
        return replace(self, left=left, right=right)


@dataclass(frozen=True)
class Roll:
    """Which frames of a recording are pairs.

    Attributes:
        names: Names without suffix of all frames in order, also of those without a partner; empty
            names where there are none.
        paired: Positions of the pairs among them.
        alone: Numbers of left and right images without a partner, which are left out.
        chosen: Which of the pairs are used; None = all.
    """

    names: Sequence[str]
    paired: Sequence[int]
    alone: tuple[int, int] = (0, 0)
    chosen: range | None = None

    def __str__(self) -> str:
        text = ""
        if any(self.alone):
            text = f", {self.alone[0]} left and {self.alone[1]} right without a partner left out"
        if self.chosen is None:
            return text
        every = f" in steps of {self.chosen.step}" if self.chosen.step > 1 else ""
        return f"{text}, frames {self.chosen[0]} to {self.chosen[-1]}{every}"

    @property
    def kept(self) -> Sequence[int]:
        """Positions of the pairs that are used."""
        return self.paired if self.chosen is None else [self.paired[k] for k in self.chosen]

    def choose(self, settings: SourceSettings, where: Path) -> Roll:
        """Return the same recording, of which the frames from ``start`` to ``end`` are used.

        Raises:
            SourceError: There are none.
        """
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
        """Return the line of each pair in a file with one line per frame, such as ``times.txt``.

        One line per pair fits at once, whether of all pairs or of those used. Else names that are
        counters give the line, so that it stays the right one where images are missing; else the
        position does, and further lines are ignored.

        Returns:
            Indices from 0; None = the file has too few lines.
        """
        of_pairs = self._lines_of_all(count)
        if of_pairs is None:
            return list(range(count)) if count == len(self.kept) else None
        return of_pairs if self.chosen is None else [of_pairs[k] for k in self.chosen]

    def _lines_of_all(self, count: int) -> list[int] | None:
        if count == len(self.paired):
            return list(range(count))
        names = [self.names[k] for k in self.paired]
        numbers = [int(name) if name.isdecimal() else count for name in names]
        if max(numbers) < count:
            return numbers
        return list(self.paired) if len(self.names) <= count else None


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key under which 2 comes before 10."""
    # Only ASCII: "²" is a digit to Python, but not a number.
    parts = enumerate(_DIGITS.split(name))
    return [(int(part), "") if at % 2 else (-1, part) for at, part in parts if part]


def partner_names(name: str) -> list[str]:
    """Return possible names of the right camera for a name of the left one, most likely first."""
    found = [other for left, right in SIDES for other in _replaced(name, left, right)]
    return list(dict.fromkeys(found))


def _replaced(name: str, left: str, right: str) -> list[str]:
    """Return a name with the mark of the left side replaced by that of the right one."""
    matches = list(re.finditer(_bounded(left), name))
    if not matches:
        return []
    # All occurrences at once ("left/left_raw"), else only the last ("cam0/cam0_0").
    last = matches[-1]
    whole = re.sub(_bounded(left), right, name)
    return [whole, name[: last.start()] + right + name[last.end() :]]


def _has(name: str, mark: str) -> bool:
    return re.search(_bounded(mark), name) is not None


def _bounded(mark: str) -> str:
    """Return the pattern of a mark; a single letter or digit counts only if it stands alone."""
    return rf"(?<![A-Za-z0-9]){mark}(?![A-Za-z0-9])" if len(mark) == 1 else mark


def split_sides(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return names of the left and of the right camera, also those without a partner."""
    known = sorted(names, key=natural_key)
    pairs = find_partners(known)
    if not pairs:
        return [], []
    mark = next(mark for mark in SIDES if pairs[0][1] in _replaced(pairs[0][0], *mark))
    paired = [{pair[side] for pair in pairs} for side in (0, 1)]
    left, right = (
        [n for n in known if n in paired[k] or (n not in paired[1 - k] and _has(n, mark[k]))]
        for k in (0, 1)
    )
    return left, right


def find_partners(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return all (left, right) pairs among some names, in natural order."""
    known = set(names)
    pairs = []
    for name in sorted(known, key=natural_key):
        partner = next((other for other in partner_names(name) if other in known), None)
        if partner is not None:
            pairs.append((name, partner))
    return pairs


def stamp_of_name(stem: str) -> float | None:
    """Return timestamp in a file name: seconds, or an integer number of ms, µs or ns since 1970.

    Returns:
        Seconds, or None if the name is not a timestamp.
    """
    if _STAMP.fullmatch(stem) is None:
        return None
    if "." in stem or len(stem) == _SECONDS_DIGITS:
        return float(stem)
    return float(int(stem) / 10 ** (len(stem) - _SECONDS_DIGITS))


def stamps_of_names(stems: Sequence[str]) -> Float64 | None:
    """Return timestamps in the file names of one camera.

    Returns:
        float64 (N,), seconds; None unless all names are timestamps, or if they are counters, such
        as KITTI's ``0000000123``.
    """
    stamps = [stamp_of_name(stem) for stem in stems]
    if any(stamp is None for stamp in stamps) or _are_counters(stems):
        return None
    return np.array(stamps, dtype=np.float64)


def _are_counters(stems: Sequence[str]) -> bool:
    """Return whether names with as many digits as a timestamp count frames.

    Today's times have no leading zero. Those of a clock that starts at 0 may have one, but are
    many of their units (ms, µs or ns) apart, and no camera is timed in whole seconds.
    """
    if any("." in stem for stem in stems) or not stems[0].startswith("0"):
        return False
    steps = np.diff([int(stem) for stem in stems])
    return len(stems[0]) == _SECONDS_DIGITS or not steps.size or np.median(steps) < _CLOCK_STEPS


def check_most(pairs: int, images: int, where: Path) -> None:
    """Refuse a recording of which most is missing.

    Args:
        pairs: Number of pairs.
        images: Number of images of one camera, found or listed.
        where: The source, for the error message.

    Raises:
        SourceError: Fewer than half of the images have a partner.
    """
    if 2 * pairs < images:
        raise SourceError(
            "most images have no partner",
            where=where,
            got=f"{pairs} pairs of {images} images",
            hint="give both images of a pair the same name or time, and copy missing files again",
        )


def check_increasing(stamps_s: Float64, where: str) -> None:
    """Check that timestamps are strictly increasing.

    Raises:
        SourceError: They are not.
    """
    backwards = np.flatnonzero(np.diff(stamps_s) <= 0)
    if backwards.size:
        at = int(backwards[0]) + 1
        still = stamps_s[at] == stamps_s[at - 1]
        raise SourceError(
            "two images have the same timestamp" if still else "timestamps are out of order",
            where=f"{where}, image {at}",
            got=f"{stamps_s[at]:.6f} s after {stamps_s[at - 1]:.6f} s",
            hint="the images of each camera must be in the order of their exposure",
        )


def pair_stamps(left_s: Float64, right_s: Float64, tolerance_s: float, where: str) -> StampPairs:
    """Pair two series of timestamps that are mutual nearest neighbours.

    Args:
        left_s: float64 (N,), seconds, increasing.
        right_s: float64 (M,), seconds, increasing.
        tolerance_s: Largest difference within a pair.
        where: The source, for the error message.

    Raises:
        SourceError: No two are close enough.
    """
    to_right, to_left = nearest_sorted(left_s, right_s), nearest_sorted(right_s, left_s)
    mutual = to_left[to_right] == np.arange(len(left_s))
    apart_s = np.abs(right_s[to_right] - left_s)
    chosen = np.flatnonzero(mutual & (apart_s <= tolerance_s))
    if not chosen.size:
        raise SourceError(
            "no left and right images were taken at the same time",
            where=where,
            got=f"at best {apart_s.min():.4g} s apart",
            expected=f"at most {tolerance_s:g} s",
            hint="raise --set source.tolerance_s= if that is the true skew of the cameras",
        )
    alone = (len(left_s) - len(chosen), len(right_s) - len(chosen))
    return StampPairs(chosen.tolist(), to_right[chosen].tolist(), alone)
