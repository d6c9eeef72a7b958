"""Drives stored as image files, one per camera and frame, and how their names pair them."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from recon.core.errors import CalibrationError, FormatError, SourceError
from recon.core.text import counted
from recon.core.values import ImuRecord, Recorded, RectifiedCamera, check_size
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.image import join_pair
from recon.io.images.image import (
    MAX_MEGAPIXELS,
    Levels,
    eight_bits,
    find_levels,
    read_levels,
    read_orientation,
)
from recon.sources.settings import SourceSettings
from recon.sources.source import FrameList, Recording, check_most, pair_frames
from recon.sources.times import pair_stamps

_SAMPLE: Final = 8  # frames, over a drive of 16-bit images, that its levels are taken from
_SAY: Final = "say how images lie: --set source.orientation=stored, or =turned"
Opened = TypeVar("Opened")


class ImageFrame(NamedTuple):
    """The two files of one frame, and the exposure time of the left one."""

    left: Path
    right: Path
    timestamp_s: float


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ImageSource(Recording):
    """A drive in image files; ``images`` are those of each frame, in order."""

    images: Sequence[ImageFrame]
    imu: Callable[[], ImuRecord] | None = None  # reads what the inertial unit measured
    truth_of_raw: bool = False
    turned: bool = False  # by EXIF orientations
    orientation: int | None = None  # that all images must have; None = any

    @cached_property
    def files(self) -> Sequence[Path]:
        images = (path for frame in self.images for path in (frame.left, frame.right))
        return [*self.texts, *images]

    @cached_property
    def stamps_s(self) -> Float64:
        return stamps_of(self.images)

    def read_imu(self) -> ImuRecord | None:
        return None if self.imu is None else self.imu()

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        for index in range(start, len(self.images)):
            frame = self.images[index]
            left, right = (self._read(path) for path in (frame.left, frame.right))
            yield join_pair(left, right, frame.timestamp_s, index, frame.left.name)

    @cached_property
    def levels(self) -> Levels:
        """What becomes black and white in all images; from a sample of both cameras."""
        frames = [self.images[index] for index in sample_of(len(self.images))]
        files = (path for frame in frames for path in (frame.left, frame.right))
        return find_levels(read_levels(path, self._most_megapixels) for path in files)

    @property
    def _most_megapixels(self) -> float:
        # A calibration was accepted for images of its size.
        rig = self.calibration
        camera = rig if isinstance(rig, RectifiedCamera) else rig.left
        return max(MAX_MEGAPIXELS, camera.width_px * camera.height_px / 1e6)

    def _read(self, path: Path) -> UInt8:
        check_orientation(path, self.orientation)
        image = read_levels(path, self._most_megapixels, turned=self.turned)
        check_size(self.calibration, image.shape[1], image.shape[0], path)
        return image if image.dtype == np.uint8 else eight_bits(image, self.levels)


def sample_of(frames: int) -> list[int]:
    """Return the frames that the levels of a drive of 16-bit images are taken from."""
    return sorted({*np.linspace(0, frames - 1, _SAMPLE).astype(int).tolist()})


def open_fitting(
    open_: Callable[[SourceSettings], Opened],
    settings: SourceSettings,
    first: Callable[[Opened], Path | None],
) -> tuple[Opened, dict[str, Any]]:
    """Open images as stored, or turned by their EXIF orientation, whichever the calibration fits.

    Returns also ``turned``, ``orientation`` and ``notes`` of an `ImageSource`. ``first`` gives the
    first image. Where sizes leave it open and the settings do not say it, it is a `SourceError`.
    """
    if settings.orientation is not None:
        return open_(settings), {"turned": settings.orientation == "turned"}
    tag, fits, errors = 1, dict[str, Opened](), []
    for how in ("stored", "turned"):
        try:
            opened = fits[how] = open_(settings.model_copy(update={"orientation": how}))
            path = first(opened)
            tag = 1 if path is None else read_orientation(path)
            if tag == 1:
                return opened, {"orientation": path and 1}
        except CalibrationError as error:  # noqa: PERF203 - of two
            errors.append(error)
    if not fits:
        raise errors[0]
    if len(fits) > 1:
        what = "images have an EXIF orientation, and the calibration fits them turned and stored"
        raise SourceError(what, where=path, got=tag, expected=1, hint=_SAY)
    (how,) = fits
    note = f"images have EXIF orientation {tag}: taken as {how}, as the calibration has their size"
    return fits[how], {"turned": how == "turned", "orientation": tag, "notes": (note,)}


def check_orientation(path: Path, expected: int | None) -> None:
    """Refuse an image whose EXIF orientation is not that of the first; None = any is right."""
    if expected is not None and (found := read_orientation(path)) != expected:
        what = "EXIF orientation of the image is not that of the first"
        raise FormatError(what, where=path, got=found, expected=expected, hint=_SAY)


def stamps_of(frames: Sequence[ImageFrame]) -> Float64:
    """Return float64 (N,), the times of some frames."""
    return np.array([frame.timestamp_s for frame in frames])


def pair_listed(
    lists: Sequence[Sequence[tuple[float, Path]]], settings: SourceSettings, where: Path
) -> tuple[list[ImageFrame], FrameList]:
    """Pair lists of time and file, by time; a listed image that is missing has no partner."""
    for one in lists:
        check_most(sum(path.is_file() for _, path in one), len(one), where)
    stamps = [np.array([stamp for stamp, _ in one]) for one in lists]
    found = pair_stamps(stamps[0], stamps[1], settings.tolerance_s, where)

    def entry(side: int, k: int | None) -> tuple[float, Path] | None:
        return None if k is None or not lists[side][k][1].is_file() else lists[side][k]

    names = [(lists[1][j or 0] if i is None else lists[0][i])[1].stem for i, j in found]
    frames = [(entry(0, i), entry(1, j)) for i, j in found]
    used, listing = pair_frames(frames, settings, where, names)
    return [ImageFrame(left, right, stamp_s) for (stamp_s, left), (_, right) in used], listing


def pair_named(
    frames: Sequence[tuple[Path | None, Path | None]], settings: SourceSettings, where: Path
) -> tuple[list[tuple[Path, Path]], FrameList]:
    """Return the pairs that are used; of ``frames`` in order, an image may be missing (None)."""
    whole = sum(None not in frame for frame in frames)
    alone_right = sum(left is None and right is not None for left, right in frames)
    alone = max(len(frames) - whole - alone_right, alone_right)
    check_most(whole, whole + alone, where)
    names = [(left or right or Path()).stem for left, right in frames]
    return pair_frames(frames, settings, where, names)


def existing(path: Path) -> Path | None:
    """Return the file, or None if it is missing."""
    return path if path.is_file() else None


def image_size(path: Path, settings: SourceSettings) -> tuple[int, int]:
    """Return width and height of an image file, at most as large as the settings allow."""
    turned = settings.orientation == "turned"
    height_px, width_px = read_levels(path, settings.max_megapixels, turned=turned).shape[:2]
    return width_px, height_px


def list_images(folder: Path) -> list[Path]:
    """Return the images of a folder in natural order: 2 before 10."""
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    paths = [path for path in folder.iterdir() if is_image(path)]
    if not paths:
        raise SourceError("folder contains no images", where=folder, expected="PNG, JPEG or PGM")
    return sorted(paths, key=lambda path: natural_key(path.name))


def is_image(path: Path) -> bool:
    """Return whether a file is an image by its suffix; hidden files do not count."""
    return path.suffix.lower() in IMAGES and not path.name.startswith(".")


IMAGES: Final = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".bmp"})
# Parts of names that mark the left camera, each with its counterpart for the right one.
SIDES: Final = (
    ("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("cam0", "cam1"), ("cam_0", "cam_1"),
    ("camera0", "camera1"), ("camera_0", "camera_1"), ("infra1", "infra2"),
    ("image_0", "image_1"), ("image_2", "image_3"), ("view1", "view5"), ("im0", "im1"),
    ("l", "r"), ("L", "R"), ("0", "1"),
)  # fmt: skip
_DIGITS: Final = re.compile(r"([0-9]+)")
_Key = tuple[object, ...]


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key under which 2 comes before 10."""
    # Only ASCII: "²" is a digit to Python, but not a number.
    parts = enumerate(_DIGITS.split(name))
    return [(int(part), "") if at % 2 else (-1, part) for at, part in parts if part]


def partner_names(name: str) -> list[str]:
    """Return possible names of the right camera for a name of the left one, most likely first."""
    return list(dict.fromkeys(other for mark in SIDES for other in _replaced(name, *mark)))


def _replaced(name: str, left: str, right: str) -> list[str]:
    matches = list(re.finditer(_bounded(left), name))
    if not matches:
        return []
    # All occurrences at once ("left/left_raw"), else only the last ("cam0/cam0_0").
    last = matches[-1]
    whole = re.sub(_bounded(left), right, name)
    return [whole, name[: last.start()] + right + name[last.end() :]]


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
    marks = [_bounded(one) for one in mark]
    paired = [{pair[side] for pair in pairs} for side in (0, 1)]
    left, right = (
        [n for n in known if n in paired[k] or (n not in paired[1 - k] and re.search(marks[k], n))]
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


@dataclass(frozen=True)
class ImagePairs:
    """Left and right images, in natural order; ``lonely`` ones have no partner and are left out."""

    pairs: tuple[tuple[Path, Path], ...]
    by_order: bool
    lonely: tuple[Path, ...] = ()


def pair_images(left: str | Path, right: str | Path) -> ImagePairs:
    """Pair the images of two cameras; each is a folder, an image or a pattern (``*?[]**``).

    Names match if they are equal apart from words and constant numbers of each side, such as
    ``left01.jpg`` and ``right01.jpg``. If none match and both sides have as many, they are paired
    by order.
    """
    sides = (find_images(left), find_images(right))
    both = set(sides[0]) & set(sides[1])
    if both:
        hint = "give two patterns or folders without a common file"
        raise SourceError("left and right are the same images", where=sorted(both)[0], hint=hint)
    for keyed in (_by_name, _by_numbers):
        keys = [keyed(side) for side in sides]
        if set(keys[0]) & set(keys[1]):
            return _match(sides, keys[0], keys[1])
    if len(sides[0]) != len(sides[1]):
        got = f"{len(sides[0])} left, {len(sides[1])} right"
        expected = "as many left as right, or names that identify the pairs"
        raise SourceError("images do not pair up", where=left, got=got, expected=expected)
    return ImagePairs(tuple(zip(*sides, strict=True)), by_order=len(sides[0]) > 1)


def find_images(where: str | Path) -> list[Path]:
    """Return the images of a folder or pattern in natural order: 2 before 10."""
    folder = Path(where)
    names = glob.glob(str(where), recursive=True)  # noqa: PTH207
    found = folder.iterdir() if folder.is_dir() else map(Path, names)
    images = [path for path in found if path.suffix.lower() in IMAGES and path.is_file()]
    if not images:
        what, hint = "no images found", 'put patterns in quotes: "left*.png"'
        raise SourceError(what, where=where, expected=", ".join(sorted(IMAGES)), hint=hint)
    return sorted(images, key=lambda path: natural_key(path.name))


def _by_name(side: Sequence[Path]) -> dict[_Key, Path]:
    return {(path.stem,): path for path in side}


def _by_numbers(side: Sequence[Path]) -> dict[_Key, Path]:
    """Return images by the numbers that vary in their names; odd counts of them are left out."""
    numbers = {path: tuple(int(word) for word in re.findall(_DIGITS, path.stem)) for path in side}
    usual = Counter(len(each) for each in numbers.values()).most_common(1)[0][0]
    numbers = {path: each for path, each in numbers.items() if len(each) == usual}
    varying = [k for k in range(usual) if len({each[k] for each in numbers.values()}) > 1]
    keyed: dict[_Key, Path] = {tuple(of[k] for k in varying): path for path, of in numbers.items()}
    return keyed if varying and len(keyed) == len(numbers) else {}


def _match(
    sides: Sequence[Sequence[Path]], left: dict[_Key, Path], right: dict[_Key, Path]
) -> ImagePairs:
    pairs = tuple((path, right[key]) for key, path in left.items() if key in right)
    paired = {path for pair in pairs for path in pair}
    lonely = tuple(path for side in sides for path in side if path not in paired)
    if 2 * len(pairs) < max(len(side) for side in sides):
        names = ", ".join(path.name for path in lonely[:3]) + (" …" if len(lonely) > 3 else "")
        raise SourceError(
            "images do not pair up: most have no partner",
            where=lonely[0].parent,
            got=f"{counted(len(pairs), 'pair')} of {len(sides[0])} left, {len(sides[1])} right; "
            f"{names}",
            hint="correct their names",
        )
    return ImagePairs(pairs, by_order=False, lonely=lonely)
