"""Frames of a video in which a calibration board stands still, each elsewhere than before."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.core.errors import SourceError
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.core.words import counted
from recon.io.images.image import write_image
from recon.io.images.video import VIDEOS, VideoFile
from recon.sources.image_names import ImagePairs
from recon.sources.settings import SourceSettings
from recon.sources.video import frames_of, open_videos, split_views, view_size
from recon.stereo.rectify.grey import to_grey

# Looks at a video per second: a hand holds a board still for longer than that.
_LOOKS_HZ: Final = 10.0
# Frames are compared at this width, at which noise of the sensor averages out.
_SMALL_PX: Final = 80
# A frame is still if it changes no more than this multiple of the stillest tenth of all frames, or
# than this many grey levels, which is what remains of noise at that size.
_STILL: Final = 2.0
_STILL_SHARE: Final = 0.1
_NOISE_DN: Final = 0.5
# The most different frames are taken, up to this number; some of them will not show the board.
_MOST: Final = 120


def is_video(where: str) -> bool:
    """Return whether an argument names a video file."""
    return Path(where).suffix.lower() in VIDEOS and Path(where).is_file()


def pick_views(
    files: Sequence[Path], settings: SourceSettings, path: Callable[[str], Path]
) -> ImagePairs:
    """Write the still frames of one or two videos that differ most as image files.

    Args:
        files: A left and a right video, or one with both views.
        settings: Arrangement of the two views in one video.
        path: Gives the path to write the file of a name to.
    """
    videos = open_videos(files)
    if len(videos) == 1:
        view_size(videos[0], settings)  # checks that the frames can be halved
    every = max(1, round(videos[0].rate_hz / _LOOKS_HZ))
    looks = range(0, frames_of(videos), every)
    small = np.stack([_shrunk(both) for both in _frames(videos, looks, settings)])
    chosen = [looks[number] for number in _choose(small)]
    if not chosen:
        raise SourceError(
            "the board never stands still in the video",
            where=files[0],
            got=counted(len(looks), "frame"),
            hint="hold it still for a second or two in each place",
        )
    pairs = []
    for number, (left, right) in zip(chosen, _frames(videos, chosen, settings), strict=True):
        pairs.append((path(f"views/left{number:06d}.png"), path(f"views/right{number:06d}.png")))
        write_image(pairs[-1][0], left)
        write_image(pairs[-1][1], right)
    return ImagePairs(tuple(pairs), by_order=False)


def _frames(
    videos: Sequence[VideoFile], numbers: Iterable[int], settings: SourceSettings
) -> Iterator[tuple[UInt8, UInt8]]:
    """Yield both views of frames of increasing numbers."""
    wanted = list(numbers)
    if len(videos) == 1:
        for _, image in videos[0].pick(wanted):
            yield split_views(image, settings)
        return
    for (_, left), (_, right) in zip(*(video.pick(wanted) for video in videos), strict=True):
        yield left, right


def _shrunk(both: tuple[UInt8, UInt8]) -> Float32:
    """Return float32 (H, W), both views side by side, small."""
    height, width = both[0].shape[:2]
    size = (_SMALL_PX, max(1, round(_SMALL_PX * height / width)))
    small = [cv2.resize(to_grey(view), size, interpolation=cv2.INTER_AREA) for view in both]
    return np.hstack(small).astype(np.float32)


def _choose(small: Float32) -> list[int]:
    """Return indices of still frames, each as different as can be from those chosen before it."""
    steps = _apart(small[1:], small[:-1])
    limit = max(_NOISE_DN, _STILL * float(np.quantile(steps, _STILL_SHARE))) if len(steps) else 0.0
    still = np.flatnonzero(_still_frames(steps, limit))
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


def _still_frames(steps: Float64, limit: float) -> Bool:
    """Return bool (N,), whether nothing moves before and after each frame, from N - 1 steps."""
    calm = steps <= limit
    return np.concatenate([calm[:1], calm[:-1] & calm[1:], calm[-1:]])
