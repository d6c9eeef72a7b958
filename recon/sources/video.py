"""Video files, decoded by OpenCV's FFmpeg, and drives in them: one per camera, or one for both."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError, FormatError, ReconError, SourceError
from recon.core.text import counted
from recon.core.values import StereoPair, check_size
from recon.core.values.arrays import UInt8
from recon.io.files import StrPath, reader, resolved
from recon.io.images.image import MAX_MEGAPIXELS, silent_opencv, swap_red_and_blue
from recon.sources.calibration import read_rig
from recon.sources.images import find_partners
from recon.sources.settings import SourceSettings
from recon.sources.source import Recording, pair_frames

_STACKED: Final = frozenset({"top-bottom", "bottom-top"})
_ABOVE: Final = "the calibration fits views one above the other: the upper one is the left camera's"
_LONGER: Final = 0.05  # fraction of a video without a partner: one camera was stopped later


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class VideoSource(Recording):
    """A drive in one video with both views, or in two; ``numbers`` are the frames of each pair."""

    videos: tuple[VideoFile, ...]
    settings: SourceSettings
    numbers: Sequence[tuple[int, int]]

    @cached_property
    def files(self) -> Sequence[Path]:
        return [*self.texts, *(video.path for video in self.videos)]

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        last_s, numbers = -np.inf, self.numbers[start:]
        views = zip(numbers, self._views(numbers), strict=True) if numbers else ()
        for index, ((number, _), (stamp_s, left, right)) in enumerate(views, start=start):
            for view in (left, right):
                check_size(self.calibration, view.shape[1], view.shape[0], self.videos[0].path)
            time_s = number / self.settings.rate_hz if self.settings.rate_hz else stamp_s
            if time_s <= last_s:
                what = "times of the video do not increase"
                hint = "give the rate with --set source.rate_hz="
                raise FormatError(what, where=f"{self.videos[0].path}, frame {number}", hint=hint)
            last_s = time_s
            yield StereoPair(left, right, time_s, index, f"frame {number}")

    def _views(self, numbers: Sequence[tuple[int, int]]) -> Iterator[tuple[float, UInt8, UInt8]]:
        """Yield the views of some pairs of frames, numbered as in the files and evenly spaced."""
        in_left, in_right = (list(side) for side in zip(*numbers, strict=True))
        if len(self.videos) == 1 and in_left == in_right:
            for stamp_s, image in self.videos[0].pick(in_left):
                yield stamp_s, *split_views(image, self.settings)
            return
        pairs = zip(self.videos[0].pick(in_left), self.videos[-1].pick(in_right), strict=True)
        apart_s: float | None = None
        both = len(self.videos) == 1
        for number, ((left_s, one), (right_s, other)) in zip(in_left, pairs, strict=True):
            # Two containers may start at different times, but must then advance alike.
            apart_s = right_s - left_s if apart_s is None else apart_s
            self._check_pace(number, right_s - left_s - apart_s)
            left, right = (
                split_views(image, self.settings) if both else (image,) for image in (one, other)
            )
            yield left_s, left[0], right[-1]

    def _check_pace(self, index: int, drift_s: float) -> None:
        period_s = 1 / self.videos[0].rate_hz
        if abs(drift_s) > period_s / 2 and self.settings.rate_hz is None:
            raise SourceError(
                "left and right videos drift apart",
                where=f"{self.videos[1].path}, frame {index}",
                got=f"{drift_s:+.4g} s since the start",
                expected=f"less than half a frame, {period_s / 2:.4g} s",
                hint="frames were dropped; or give the rate with --set source.rate_hz=",
            )


def open_video_source(path: Path, settings: SourceSettings) -> VideoSource:
    """Open one video, a left one (``settings.right`` is the other), or those of a folder."""
    videos = open_videos(_find_videos(path, settings))
    frames = zip_longest(range(videos[0].frames), range(videos[-1].frames))
    numbers, listing = pair_frames(list(frames), settings, path)
    size = view_size(videos[0], settings) if len(videos) == 1 else videos[0].size_px
    home = path if path.is_dir() else resolved(path).parent
    try:
        rig, texts = read_rig(settings, home, size)
    except CalibrationError as error:
        hint = _how_to_cut(videos[0], settings, home) if len(videos) == 1 else None
        above = settings.model_copy(update={"side_by_side": "top-bottom"})
        if settings.side_by_side == "left-right" and hint and hint.endswith("top-bottom"):
            return replace(open_video_source(path, above), notes=(_ABOVE,))
        raise error.copy_with(hint=hint or error.hint) from error
    rate_hz = settings.rate_hz or videos[0].rate_hz
    layout = "two videos" if len(videos) == 2 else f"{settings.side_by_side} in one video"
    return VideoSource(
        name=resolved(path).name,
        description=f"{layout}, {rate_hz:g} Hz, paired frame by frame{listing}",
        calibration=rig,
        videos=videos,
        settings=settings,
        numbers=numbers,
        texts=texts,
        listing=listing,
    )


def open_videos(files: Sequence[Path]) -> tuple[VideoFile, ...]:
    """Open one video, or a left and a right one that belong together."""
    videos = tuple(open_video(file) for file in files)
    if len(videos) == 1:
        return videos
    left, right = videos
    both: dict[str, tuple[object, object]] = {
        "sizes": ("{}x{}".format(*left.size_px), "{}x{}".format(*right.size_px)),
        "frame rates": (round(left.rate_hz, 2), round(right.rate_hz, 2)),
    }
    if abs(left.frames - right.frames) > _LONGER * max(left.frames, right.frames):
        both["numbers of frames"] = (left.frames, right.frames)
    for name, (ours, theirs) in both.items():
        if ours != theirs:
            what = f"left and right videos have different {name}"
            got = f"left {ours}, right {theirs}"
            hint = "cut both to the frames that were taken together"
            raise SourceError(what, where=right.path, got=got, hint=hint)
    return videos


def list_videos(folder: Path) -> list[str]:
    """Return names of the video files in a folder."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in VIDEOS)
    return sorted(path.name for path in files if path.is_file())


def view_size(video: VideoFile, settings: SourceSettings) -> tuple[int, int]:
    """Return the width and height of one of the two views in a video."""
    stacked = settings.side_by_side in _STACKED
    whole = video.height_px if stacked else video.width_px
    if whole % 2:
        what, got = "frames of the video cannot be halved", f"{video.width_px}x{video.height_px}"
        hint = (
            "for two videos: recon map LEFT --right RIGHT; source.side_by_side tells how views lie"
        )
        raise SourceError(what, where=video.path, got=got, hint=hint)
    width_px, height_px = video.size_px
    return (width_px, height_px // 2) if stacked else (width_px // 2, height_px)


def _how_to_cut(video: VideoFile, settings: SourceSettings, home: Path) -> str | None:
    """Return what to do with a video whose views, cut in another way, have the calibrated size."""
    width_px, height_px = video.size_px
    fits = "the calibration fits it cut so: --set source.side_by_side="
    for size, hint in (
        ((width_px, height_px), "it shows one camera: name the video of the other with --right"),
        ((width_px, height_px // 2), f"{fits}top-bottom"),
        ((width_px // 2, height_px), f"{fits}left-right"),
    ):
        with suppress(ReconError):
            read_rig(settings, home, size)
            return hint
    return None


def split_views(image: UInt8, settings: SourceSettings) -> tuple[UInt8, UInt8]:
    """Split a frame into its left and right view."""
    axis = 0 if settings.side_by_side in _STACKED else 1
    first, second = (np.ascontiguousarray(view) for view in np.split(image, 2, axis=axis))
    swapped = settings.side_by_side in {"right-left", "bottom-top"}
    return (second, first) if swapped else (first, second)


def _find_videos(path: Path, settings: SourceSettings) -> list[Path]:
    if path.is_file():
        settings.refuse_names(("left",), path, "leave it out; SOURCE is the left video")
        return [path] if settings.right is None else [path, Path(settings.right)]
    if not path.is_dir():
        raise SourceError("file does not exist", where=path)
    if (named := settings.named_in(path)) is not None:
        return list(named)
    names = list_videos(path)
    pairs = find_partners(names)
    if pairs:
        return [path / name for name in pairs[0]]
    if len(names) != 1:
        what = "folder has neither one video nor a left and a right one"
        got = ", ".join(names) or "no video"
        raise SourceError(what, where=path, got=got, hint="name them with --left and --right")
    return [path / names[0]]


VIDEOS: Final = frozenset(
    {".avi", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ts", ".webm"}
)
# A container may derive its number of frames from its duration, with rounding.
_COUNT_TOLERANCE: Final = 2


@dataclass(frozen=True)
class VideoFile:
    """A video file as its container and packets describe it; an orientation tag is ignored."""

    path: Path
    frames: int
    width_px: int
    height_px: int
    rate_hz: float

    @property
    def size_px(self) -> tuple[int, int]:
        return self.width_px, self.height_px

    def pick(self, numbers: Iterable[int]) -> Iterator[tuple[float, UInt8]]:
        """Yield frames of increasing numbers: seconds from the start, and uint8 (H, W, 3) RGB."""
        with _opened(self.path) as capture:
            after = 0
            for index in numbers:
                for each in range(after, index + 1):
                    if not capture.grab():
                        raise self._broken(each)
                after = index + 1
                stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                done, image = capture.retrieve()
                if not done:
                    raise self._broken(index)
                yield stamp_s, swap_red_and_blue(image)

    def _broken(self, index: int) -> FormatError:
        return FormatError(
            "video cannot be decoded to its end",
            where=self.path,
            got=counted(index, "frame"),
            expected=f"{self.frames}",
            hint="copy the file again, or cut it before the damage",
        )


@reader
def open_video(path: StrPath) -> VideoFile:
    """Open a video file and count its frames without decoding them."""
    file = Path(path)
    if not file.is_file():
        raise FormatError("file does not exist", where=file)
    with _opened(file) as capture:
        promised = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        rate_hz = capture.get(cv2.CAP_PROP_FPS)
        size = [int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if size[0] * size[1] > MAX_MEGAPIXELS * 1e6:
            got, expected = f"{size[0]}x{size[1]}", f"at most {MAX_MEGAPIXELS:g} million"
            raise FormatError("video has too many pixels", where=file, got=got, expected=expected)
        if not capture.grab() or not rate_hz > 0:
            raise FormatError("video has no frame that can be decoded", where=file)
    frames = _count(file)
    if frames < promised - _COUNT_TOLERANCE:
        got, expected = counted(frames, "frame"), f"{promised:.0f}, as its header says"
        hint = f"copy the file again, or repair it: ffmpeg -i {file.name} -c copy whole.mkv"
        raise FormatError("video is truncated", where=file, got=got, expected=expected, hint=hint)
    return VideoFile(file, frames, size[0], size[1], rate_hz)


def _count(path: Path) -> int:
    with _opened(path) as capture:
        capture.set(cv2.CAP_PROP_FORMAT, -1)  # raw packets, not decoded
        count = 0
        while capture.grab():
            count += 1
    return count


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    # Stop FFmpeg from logging to standard error what we raise as an exception anyway.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with silent_opencv():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            hint = "it may be truncated or use an unknown codec; try: ffmpeg -i FILE copy.mkv"
            raise FormatError("not a readable video", where=path, hint=hint)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()
