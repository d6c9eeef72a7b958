"""The places of a drive: which may be near by odometry, and which look similar."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import angle_rad, invert
from recon.core.values.arrays import Bool, Float64
from recon.places.drift import SIGMAS, spread_over

_LONGEST_RUN: Final = 256  # images: half a million words, which merge in 50 ms and 10 MB


_MIN_PATH_M: Final = 25.0
"""Least path between two places that are compared."""

VIEW_M: Final = 8.0
"""Largest distance at which two places see enough in common."""

VIEW_DEG: Final = 45.0
"""Largest such angle between their viewing directions."""

_MOST: Final = 3
"""Most candidates that are verified."""

_APART_M: Final = 4.0
"""Least distance between two candidates."""


@dataclass(frozen=True, eq=False)
class Place:
    """What is kept in memory of a keyframe.

    Attributes:
        frame: Its frame.
        T_world_camera: float64 (4, 4), by odometry.
        path_m: Path up to it, by `path_lengths`.
        words: uint32 (W,), sorted, each once.
    """

    frame: int
    T_world_camera: Float64
    path_m: float
    words: NDArray[np.uint32]


class Places:
    """All places so far, in order; a query among thousands takes some milliseconds."""

    def __init__(self) -> None:
        self._frames: list[int] = []
        self._poses = np.empty((64, 4, 4))
        self._path_m = np.empty(64)
        self._words = WordIndex()

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, place: Place) -> None:
        """Add the next place."""
        count = len(self)
        if count == len(self._path_m):
            self._poses = np.concatenate([self._poses, np.empty_like(self._poses)])
            self._path_m = np.concatenate([self._path_m, np.empty_like(self._path_m)])
        self._poses[count], self._path_m[count] = place.T_world_camera, place.path_m
        self._frames.append(place.frame)
        self._words.add(place.words)

    @property
    def frames(self) -> list[int]:
        """The frame of each place."""
        return self._frames

    @property
    def T_world_camera(self) -> Float64:
        """float64 (N, 4, 4)."""
        return self._poses[: len(self)]

    @property
    def path_m(self) -> Float64:
        """float64 (N,)."""
        return self._path_m[: len(self)]

    def near(self, place: Place) -> Bool:
        """Return bool (N,), places that drift allows to be in view of a later one."""
        way_m = place.path_m - self.path_m
        sigma_m, sigma_rad = spread_over(np.maximum(way_m, 0.0))
        T = invert(self.T_world_camera) @ place.T_world_camera
        far_m = np.linalg.norm(T[:, :3, 3], axis=1) - SIGMAS * sigma_m
        turned = angle_rad(T) - SIGMAS * sigma_rad
        near = (far_m <= VIEW_M) & (turned <= np.deg2rad(VIEW_DEG))
        return np.asarray(near & (way_m >= _MIN_PATH_M))

    def likeness(self, place: Place) -> Float64:
        """Return float64 (N,), similarity of each to a place, in [0, 1]."""
        return self._words.likeness(place.words)


def most_alike(likeness: Float64, worth: NDArray[np.intp], stands_m: Float64) -> list[int]:
    """Return the numbers of the few most similar images, each at some distance from the others.

    Args:
        likeness: float64 (N,), similarity of each image.
        worth: Numbers of those that may be chosen.
        stands_m: float64 (N, K), where each was taken.
    """
    chosen: list[int] = []
    for number in worth[np.argsort(-likeness[worth], kind="stable")].tolist():
        gaps_m = np.linalg.norm(stands_m[chosen] - stands_m[number], axis=1)
        if gaps_m.min(initial=np.inf) >= _APART_M:
            chosen.append(number)
        if len(chosen) == _MOST:
            break
    return chosen


@dataclass(frozen=True, eq=False)
class _Run:
    """The sorted words of consecutive images, with the image of each.

    Attributes:
        first: Number of the first image.
        count: Number of images.
        words: uint32 (W,), sorted.
        owners: uint16 (W,), image of each word, counted from the first.
    """

    first: int
    count: int
    words: NDArray[np.uint32]
    owners: NDArray[np.uint16]

    def followed_by(self, other: _Run) -> _Run:
        """Return two runs as one."""
        words = np.concatenate([self.words, other.words])
        owners = np.concatenate([self.owners, other.owners + np.uint16(self.count)])
        # The stable sort detects the two sorted runs and merges them.
        order = np.argsort(words, kind="stable")
        return _Run(self.first, self.count + other.count, words[order], owners[order])

    def shared(self, words: NDArray[np.uint32]) -> NDArray[np.intp]:
        """Return int64 (count,), number of words that each image shares with another one."""
        begin, end = (np.searchsorted(self.words, words, side) for side in ("left", "right"))
        # words[k] is in the run at begin[k] … end[k] - 1.
        found = end - begin
        before = np.cumsum(found) - found
        places = np.arange(found.sum()) + np.repeat(begin - before, found)
        return np.bincount(self.owners[places], minlength=self.count)


class WordIndex:
    """An inverted index: which images have which words.

    Runs of sorted words are merged when they have the same size, as in a binary counter, up to a
    size that still merges in little time and memory.

    Ref:
        O'Neil et al., "The log-structured merge-tree", Acta Informatica 1996.
    """

    def __init__(self) -> None:
        self._sizes: list[int] = []
        self._runs: list[_Run] = []

    def add(self, words: NDArray[np.uint32]) -> None:
        """Add the distinct, sorted words of the next image."""
        run = _Run(len(self._sizes), 1, np.asarray(words), np.zeros(len(words), np.uint16))
        self._sizes.append(len(words))
        while self._runs and self._runs[-1].count == run.count < _LONGEST_RUN:
            run = self._runs.pop().followed_by(run)
        self._runs.append(run)

    def likeness(self, words: NDArray[np.uint32]) -> Float64:
        """Return float64 (N,), shared words of each image and another one, normalised to [0, 1]."""
        shared = np.zeros(len(self._sizes))
        for run in self._runs:
            shared[run.first : run.first + run.count] = run.shared(words)
        sizes = np.sqrt(np.array(self._sizes, np.float64) * len(words))
        return np.divide(shared, sizes, out=np.zeros(len(shared)), where=sizes > 0)
