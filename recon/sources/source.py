"""The base class of all sources of stereo pairs, of recordings, and of what is made of a source."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from recon.core.dates import Date, date_of_stamp
from recon.core.errors import SourceError
from recon.core.summary import Figures, optional
from recon.core.text import counted, is_count
from recon.core.values import ImuRecord, OccupancyTruth, Recorded, Rig, SequenceTruth, Trajectory
from recon.core.values.arrays import Float64, freeze
from recon.io.files import fingerprint
from recon.io.trajectory import read_tum
from recon.sources.settings import SourceSettings


@dataclass(frozen=True, eq=False)
class ReadPrior:
    """A path by other sensors, on the clock of the images; ``origin`` says in one line whose."""

    path: Trajectory
    origin: str


BASES: Final = ("base_footprint", "base_link")
"""How the name of a robot's base ends: on the ground (REP 120), or anywhere on it (REP 105)."""


@dataclass(frozen=True, eq=False)
class Mount:
    """Where the left camera is on a robot, by the robot's own static transforms (REP 105).

    ``T_base_camera`` is float64 (4, 4), of the camera as mounted or of its rectified view, as is
    said; the base has x forward, y left, z up (REP 103).
    """

    T_base_camera: Float64
    base: str = "base_link"  # name of the frame of the robot
    camera: str = "left"  # name of the frame of the images
    # The frame that all others hang from, and where it is in the base; "" = the base itself. It is
    # what odometry moves: a frame has one parent.
    root: str = ""
    T_base_root: Float64 = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        freeze(self, "T_base_camera", np.float64, (4, 4))
        freeze(self, "T_base_root", np.float64, (4, 4))

    @property
    def camera_height_m(self) -> float | None:
        """Height of the camera above the ground; None = the base may be anywhere above it."""
        height_m = float(self.T_base_camera[2, 3])
        return height_m if self.base.rpartition("/")[2] == BASES[0] and height_m > 0 else None


@dataclass(frozen=True)
class Latency(Figures):
    """Milliseconds from when an image was taken to its pose; None = there is no pose."""

    p50: float | None
    p95: float | None
    max: float | None


@dataclass(frozen=True, kw_only=True)
class LiveFigures(Figures):
    """How a drive was kept up with while its images arrived."""

    rate: float | None  # how many times as fast as recorded it was played; None = cameras
    frames_arrived: int
    frames_dropped: int
    frames_not_matched: int
    latency_ms: Latency


@dataclass(frozen=True, kw_only=True)
class SourceFigures(Figures):
    """What a source knows of a drive that was read."""

    frames_left_out: int | None = optional()  # images without a partner
    live: LiveFigures | None = optional()


class StereoSource(ABC):
    """An ordered sequence of stereo pairs from one rig, read lazily.

    The base of every source, also of those of users: a subclass has a `calibration`, ``len()`` and
    `frames`; what is a property here may be a plain attribute there.
    """

    live: bool = False
    """Whether pairs arrive in their own time: poses come first, and what is late is left out."""
    patient: bool = False
    """Of a live source: whether the next pair waits until the one before is mapped."""
    lead: int = 0
    """Pairs at the start that only lead the odometry, and are not put into the map."""
    truth_of_raw: bool = False
    """Whether the true path is that of the left camera as mounted, not of its rectified view."""

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

    stereo: bool = True  # whether two cameras were recorded; else frames bring their disparity
    rigid: bool = True  # whether both cameras are rigid to each other; else frames are distrusted

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
    def frames(self, start: int = 0) -> Iterator[Recorded]:
        """Yield the pairs in order, one in memory at a time, from pair ``start`` on.

        Earlier pairs are skipped as cheaply as the input allows. A damaged image is a
        `FormatError`, one of another size than the calibration a `CalibrationError`.
        """

    def __iter__(self) -> Iterator[Recorded]:
        return self.frames()

    def with_calibration(self, calibration: Rig, *, rigid: bool = True) -> StereoSource:
        """Return this source with another calibration of the same cameras."""
        other = copy(self)
        # Of a subclass the calibration may be a property, or an attribute of its own, and frozen.
        kind = type(type(self).__name__, (type(self),), {"calibration": calibration})
        object.__setattr__(other, "__class__", kind)
        vars(other).update(calibration=calibration, rigid=rigid)
        return other

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name}, pairs: {len(self)}, {self.description})"

    def lines(self, count: int) -> list[int] | None:
        """Return the line of each pair in a file of one per frame; None = it has too few lines."""
        return list(range(len(self))) if count >= len(self) else None

    def number_of(self, image: str) -> int | None:
        """Return the number of the pair whose left image has this name, or number; None = none."""
        stem = Path(image).stem
        return int(stem) if is_count(stem) and int(stem) < len(self) else None

    def shift_of(self, pairs: int) -> int | None:
        """Return ``source.shift_frames`` for right images of so many pairs later; None = none."""
        return None

    def shifted(self, pairs: int) -> StereoSource | None:
        """Return the same drive with right images of so many pairs later; None = it cannot be."""
        return None

    def read_prior(self, name: str) -> ReadPrior:
        """Read the motion by other sensors: a TUM file, or what else this kind of source has."""
        return ReadPrior(read_tum(name), name)

    def read_imu(self) -> ImuRecord | None:
        """Read the inertial unit of the rig; None = there is none, `ReconError`: it is damaged.

        That of a live source is what it measured in the last seconds.
        """
        return None

    def recent_path(self) -> Trajectory | None:
        """Return the path of the left camera in the last seconds by wheels; None = there are none.

        Only live sources have one; that of a recording is a prior.
        """
        return None

    def read_mount(self) -> Mount | None:
        """Read where the left camera, as mounted, is on the robot; None = nothing says so."""
        return None

    def asked_start(self) -> Float64 | None:
        """Return ``T_map_base`` (4, 4) where a user says that a live drive is; None = nothing new.

        Roughly, and for a drive that is looked for in a map.
        """
        return None

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

    def figures(self) -> SourceFigures:
        """Return the same as figures."""
        return SourceFigures()

    def due_s(self, pair: Recorded) -> float:
        """Return when the newest pair of a live source was there, by `time.monotonic`."""
        return pair.timestamp_s

    def hurried(self) -> bool:
        """Return whether the next pair has arrived already, so that this one is late."""
        return False

    def note_located(self, index: int) -> None:  # noqa: B027 - only live sources care
        """Note that the pose of pair ``index`` of those yielded is known."""

    def note_unmatched(self) -> None:  # noqa: B027
        """Note that there is no time to match a pair that was yielded."""


def check_source(source: object, *, stereo: bool = False) -> None:
    """Refuse what is not a `StereoSource`, such as a path; or what is not of two cameras."""
    if not isinstance(source, StereoSource):
        what = "not a source of stereo pairs"
        expected = "what recon.open_source returns, or a subclass of recon.StereoSource"
        raise SourceError(what, got=type(source).__name__, expected=expected)
    if stereo and not source.stereo:
        raise SourceError("this needs two cameras, not one with depth", where=source.name)


_SAMPLES: Final = 32  # of a file: a change over a 31st of it is seen, and all of up to 128 KiB


def mark_of(source: StereoSource) -> dict[str, Any]:
    """Return what a source is known again by: number of pairs, names and samples of its files."""
    return {"frames": len(source), **fingerprint(source.files, samples=_SAMPLES)}


_TEXTS: Final = frozenset((".txt", ".csv", ".json", ".toml", ".xml", ".yaml", ".yml"))


def date_of(source: StereoSource) -> Date:
    """Return when a drive began, by its first stamp, or else by the time of its first images.

    That of a file may be the time of a copy, and is none of the drive's where files have no times.
    """
    stamps_s = source.stamps_s
    if stamps_s is not None and len(stamps_s):
        found = date_of_stamp(float(stamps_s[0]))
        if found.text:
            return found
    images = (file for file in source.files if file.suffix.lower() not in _TEXTS)
    first = next(images, None)
    if source.live or first is None or not first.is_file():
        return Date()
    return date_of_stamp(first.stat().st_mtime, "file")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Recording(StereoSource):
    """A recorded drive, of which frames may lack a partner."""

    name: str
    description: str
    calibration: Rig
    listing: FrameList  # which frames of the recording are pairs
    texts: tuple[Path, ...]  # calibration and other text files that were read
    notes: tuple[str, ...] = ()  # on the calibration, for the user
    truth: SequenceTruth | None = None
    # Opens it again, with right images that were taken so many frames later
    again: Callable[[int], StereoSource] | None = None

    @cached_property
    def left_out(self) -> int:
        return sum(self.listing.alone)

    def __len__(self) -> int:
        return len(self.listing.kept)

    def lines(self, count: int) -> list[int] | None:
        return self.listing.lines(count)

    def number_of(self, image: str) -> int | None:
        names = [self.listing.names[k] for k in self.listing.kept]
        stem = Path(image).stem
        return names.index(stem) if stem in names else super().number_of(image)

    def shift_of(self, pairs: int) -> int:
        chosen = self.listing.chosen
        return self.listing.shift + pairs * (1 if chosen is None else chosen.step)

    def shifted(self, pairs: int) -> StereoSource | None:
        return None if self.again is None else self.again(self.shift_of(pairs))

    def warnings(self) -> list[str]:
        out = f"{counted(self.left_out, 'image')} without a partner: left out"
        return [out, *self.notes] if self.left_out else [*self.notes]

    def figures(self) -> SourceFigures:
        return SourceFigures(frames_left_out=self.left_out)


class DerivedSource(StereoSource):
    """A source made of another one, with its name, calibration and files, but without its truth."""

    name: str
    description: str
    calibration: Rig
    files: Sequence[Path]

    def __init__(self, source: StereoSource) -> None:
        check_source(source)
        self.source, self.name, self.description = source, source.name, source.description
        self.calibration, self.files, self.stereo = source.calibration, source.files, source.stereo

    def read_mount(self) -> Mount | None:
        return self.source.read_mount()


class SourcePart(DerivedSource):
    """Pairs ``first`` to ``last - 1`` of a source, of which ``lead`` only lead the odometry."""

    def __init__(self, source: StereoSource, first: int, last: int, lead: int = 0) -> None:
        super().__init__(source)
        self.first, self.last, self.lead = first, last, lead
        self.name = f"{source.name} {first} to {last - 1}"

    def __len__(self) -> int:
        return self.last - self.first

    @cached_property
    def stamps_s(self) -> Float64 | None:
        stamps_s = self.source.stamps_s
        return None if stamps_s is None else stamps_s[self.first : self.last]

    def read_imu(self) -> ImuRecord | None:
        return self.source.read_imu()

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        return islice(self.source.frames(self.first + start), len(self) - start)


Item = TypeVar("Item")
Left = TypeVar("Left")
Right = TypeVar("Right")

_ONE_RATE: Final = 2 / 3  # fraction of frames with both images, from which cameras have one rate


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
        later = counted(self.shift, "frame", form="+d")
        text = f", right images {later} later" if self.shift else ""
        if any(self.alone):
            text += f", {self.alone[0]} left and {self.alone[1]} right without a partner left out"
        if self.chosen is None:
            return text
        every = f" in steps of {self.chosen.step}" if self.chosen.step > 1 else ""
        return f"{text}, frames {self.chosen[0]} to {self.chosen[-1]}{every}"

    @property
    def kept(self) -> Sequence[int]:
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
            what = "no frame is chosen"
            got = f"from {settings.start} to before {settings.end or len(self.paired)}"
            expected, hint = f"frames from 0 to {len(self.paired) - 1}", "see --start and --end"
            raise SourceError(what, where=where, got=got, expected=expected, hint=hint)
        return replace(self, chosen=chosen)

    def lines(self, count: int) -> list[int] | None:
        """Return the line of each pair, from 0, in a file of one per frame; None = too few lines.

        One line per pair fits at once, whether of all pairs or of those used. Else names that are
        counters give the line, so that it stays right where images are missing, or the position.
        """
        if count == len(self.paired):
            return self.used(range(count))
        names = (self.names[k] for k in self.paired)
        numbers = [int(name) if is_count(name) else count for name in names]
        if max(numbers) < count:
            return self.used(numbers)
        if len(self.names) <= count:
            return self.used(self.paired)
        return list(range(count)) if count == len(self.kept) else None


def pair_frames(
    frames: Sequence[tuple[Left | None, Right | None]],
    settings: SourceSettings,
    where: Path,
    names: Sequence[str] | None = None,
) -> tuple[list[tuple[Left, Right]], FrameList]:
    """Return the pairs that are used of frames with a left and right image, None = missing."""
    alone_right = sum(left is None and right is not None for left, right in frames)
    # A listed frame without any image counts as one, on the left.
    alone_left = sum(right is None for _, right in frames)
    pairs, places = [], []
    for place, (left, right) in enumerate(_shift_right(frames, settings.shift_frames, where)):
        if left is not None and right is not None:
            pairs.append((left, right))
            places.append(place)
    known = [""] * len(frames) if names is None else names
    listing = FrameList(known, places, (alone_left, alone_right), shift=settings.shift_frames)
    listing = listing.choose(settings, where)
    return listing.used(pairs), listing


def _shift_right(
    frames: Sequence[tuple[Left | None, Right | None]], by: int, where: Path
) -> Sequence[tuple[Left | None, Right | None]]:
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
        what = "no pair is left with right images that were taken later"
        got = f"source.shift_frames={by}, {counted(len(chosen), 'frame')}"
        expected = "fewer frames than the recording has, or 0"
        raise SourceError(what, where=where, got=got, expected=expected)
    return shifted


def check_most(pairs: int, images: int, where: Path) -> None:
    """Refuse a recording of which most is missing; ``images`` of one camera, found or listed."""
    if 2 * pairs < images:
        got = f"{counted(pairs, 'pair')} of {counted(images, 'image')}"
        hint = "give both images of a pair the same name or time, and copy missing files again"
        raise SourceError("most images have no partner", where=where, got=got, hint=hint)
