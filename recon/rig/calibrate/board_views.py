"""Still views of a video, and a calibration board found in all images of a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError, SourceError
from recon.core.progress import tracked
from recon.core.text import counted
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.core.values.board import CalibrationBoard
from recon.core.work import side_by_side
from recon.io.images.image import read_image, write_image
from recon.rig.calibrate.bundle import Sighting, View
from recon.rig.calibrate.detect import (
    check_charuco,
    check_chessboard,
    grown_size,
    orient_like,
)
from recon.rig.calibrate.patterns import find_board
from recon.sources.images import ImagePairs
from recon.sources.settings import SourceSettings
from recon.sources.video import VIDEOS, VideoFile, open_videos, split_views, view_size
from recon.stereo.rectify.rectifier import to_grey

_LOOKS_HZ: Final = 10.0  # looks at a video per second: a hand holds a board still for longer
_SMALL_PX: Final = 80  # frames are compared at this width, at which sensor noise averages out
# A frame is still if it changes no more than this multiple of the stillest tenth of all frames, or
# than this many grey levels, which is what remains of noise at that size.
_STILL: Final = 2.0
_STILL_RATIO: Final = 0.1
_NOISE_DN: Final = 0.5
_MOST: Final = 120  # frames that are taken at most; some of them will not show the board


@dataclass(frozen=True, eq=False)
class BoardViews:
    """Views of a board in the images of a rig."""

    views: tuple[View, ...]  # views in which both cameras see the board, named by the left file
    pairs: dict[str, tuple[Path, Path]]  # left and right file of each view, by name
    empty: tuple[Path, ...]  # files in which the board is not found
    size_px: tuple[int, int]  # (width, height) of every image
    count: int  # number of image pairs
    board: CalibrationBoard  # as detected; its ``legacy`` layout may differ from that given


@dataclass(frozen=True, eq=False)
class _Look:
    """The detection in one image, which is not kept; ``grown``: see `grown_size`."""

    size_px: tuple[int, int]
    seen: Sighting | None
    grown: tuple[int, int] | None


def find_views(images: ImagePairs, board: CalibrationBoard, threads: int) -> BoardViews:
    """Find a board in all images of a rig."""
    files = [path for pair in images.pairs for path in pair]
    board, looks = _look_at_all(files, board, threads)
    size = looks[0].size_px
    for path, look in zip(files, looks, strict=True):
        if look.size_px != size:
            got, other = ("x".join(map(str, each)) for each in (look.size_px, size))
            what, expected = "images differ in size", f"{other} as {files[0].name}"
            hint = "both cameras must record the same size"
            raise SourceError(what, where=path, got=got, expected=expected, hint=hint)
    if board.kind == "chess":
        check_chessboard([look.grown for look in looks], lambda n: _read_grey(files[n]), board)
    elif board.kind == "charuco" and not any(look.seen for look in looks):
        check_charuco(len(files), lambda n: _read_grey(files[n]), board)
    if not any(look.seen for look in looks):
        raise CalibrationError(
            "the board was not found in any image",
            where=files[0].parent,
            got=counted(len(files), "image"),
            expected=str(board),
            hint="all of it must be in view, with a light margin, sharp and evenly lit",
        )
    empty = tuple(path for path, look in zip(files, looks, strict=True) if look.seen is None)
    views, pairs = {}, {}
    for pair, first, second in zip(images.pairs, looks[::2], looks[1::2], strict=True):
        if (left := first.seen) is not None and (right := second.seen) is not None:
            if not board.numbered:
                pixels = orient_like(left.pixels, right.pixels, board.inner)
                right = replace(right, pixels=pixels)
            views[pair[0].name], pairs[pair[0].name] = View(pair[0].name, (left, right)), pair
    return BoardViews(tuple(views.values()), pairs, empty, size, len(images.pairs), board)


def _look_at_all(
    files: Sequence[Path], board: CalibrationBoard, threads: int
) -> tuple[CalibrationBoard, list[_Look]]:
    """Return detections in all images, and the board, which may have the other layout."""
    seen = side_by_side(lambda path: _look(path, board), files, threads=threads)
    looks = list(tracked(seen, "images", "find the board", total=len(files)))
    if not board.dictionary or any(look.seen for look in looks):
        return board, looks
    other = replace(board, legacy=not board.legacy)
    seen = side_by_side(lambda path: _look(path, other), files, threads=threads)
    older = list(tracked(seen, "images", "find its other layout", total=len(files)))
    return (other, older) if any(look.seen for look in older) else (board, looks)


def _look(path: Path, board: CalibrationBoard) -> _Look:
    grey = _read_grey(path)
    seen = find_board(grey, board)
    grown = None
    if seen is not None and board.kind == "chess":
        grown = grown_size(grey, seen.pixels, board.inner)
    return _Look((grey.shape[1], grey.shape[0]), seen, grown)


def _read_grey(path: Path) -> UInt8:
    return to_grey(read_image(path))


def is_video(where: str) -> bool:
    """Return whether an argument names a video file."""
    return Path(where).suffix.lower() in VIDEOS and Path(where).is_file()


def pick_views(
    files: Sequence[Path], settings: SourceSettings, path: Callable[[str], Path]
) -> ImagePairs:
    """Write the still frames that differ most, of two videos or one with both views."""
    videos = open_videos(files)
    every = max(1, round(videos[0].rate_hz / _LOOKS_HZ))
    looks = range(0, min(video.frames for video in videos), every)
    seen = tracked(_frames(videos, looks, settings), "frames", "find still views", total=len(looks))
    width_px, height_px = view_size(videos[0], settings) if len(videos) == 1 else videos[0].size_px
    size = (_SMALL_PX, max(1, round(_SMALL_PX * height_px / width_px)))
    small = [
        np.hstack([cv2.resize(to_grey(one), size, interpolation=cv2.INTER_AREA) for one in both])
        for both in seen
    ]
    chosen = [looks[number] for number in _choose(np.stack(small).astype(np.float32))]
    if not chosen:
        raise SourceError(
            "the board never stands still in the video",
            where=files[0],
            got=counted(len(looks), "frame"),
            hint="hold it still for a second or two in each place",
        )
    pairs = []
    for number, views in zip(chosen, _frames(videos, chosen, settings), strict=True):
        pair = path(f"views/left{number:06d}.png"), path(f"views/right{number:06d}.png")
        for file, view in zip(pair, views, strict=True):
            write_image(file, view)
        pairs.append(pair)
    return ImagePairs(tuple(pairs), by_order=False)


def _frames(
    videos: Sequence[VideoFile], numbers: Sequence[int], settings: SourceSettings
) -> Iterator[tuple[UInt8, UInt8]]:
    for images in zip(*(video.pick(list(numbers)) for video in videos), strict=True):
        views = [image for _, image in images]
        yield split_views(views[0], settings) if len(views) == 1 else (views[0], views[1])


def _choose(small: Float32) -> list[int]:
    """Return indices of still frames, each as different as can be from those chosen before it."""
    steps = _apart(small[1:], small[:-1])
    limit = max(_NOISE_DN, _STILL * float(np.quantile(steps, _STILL_RATIO))) if len(steps) else 0.0
    calm = steps <= limit  # nothing moves before a still frame, nor after it
    still = np.flatnonzero(np.concatenate([calm[:1], calm[:-1] & calm[1:], calm[-1:]]))
    if not len(still):
        return []
    chosen, apart = [int(still[0])], np.full(len(still), np.inf)
    while len(chosen) < _MOST:
        apart = np.minimum(apart, _apart(small[still], small[chosen[-1]]))
        if apart.max() <= limit:
            break
        chosen.append(int(still[np.argmax(apart)]))
    return sorted(chosen)


def _apart(first: Float32, second: Float32) -> Float64:
    """Return float64 (N,), rms difference of N images from others, or from one; grey levels."""
    return np.asarray(np.sqrt(((first - second) ** 2).mean(axis=(1, 2), dtype=np.float64)))
