"""Plain folders of images: one per camera, or one with the images of both.

::

    folder/
      left/ right/     images (or cam0 cam1, infra1 infra2, image_left image_right …)
      frames.csv       optional, written by `recon capture`: left file, right file, their times
      times.txt        optional: seconds, one line per pair; wins over times in names
      groundtruth.txt  optional: t tx ty tz qx qy qz qw of the left camera
      calib.txt        or any other supported calibration file
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import SourceError
from recon.core.text import counted
from recon.core.values.arrays import Float64
from recon.io.cameras.kitti import kitti_cameras_of
from recon.io.files import resolved
from recon.io.trajectory import FRAMES, read_frames
from recon.sources.calibration import read_rig
from recon.sources.images import (
    ImageFrame,
    ImageSource,
    existing,
    find_partners,
    image_size,
    is_image,
    list_images,
    natural_key,
    pair_listed,
    pair_named,
    partner_names,
    split_sides,
    stamps_of,
)
from recon.sources.settings import SourceSettings
from recon.sources.source import FrameList
from recon.sources.times import (
    check_increasing,
    read_times_of_pairs,
    read_tum_truth,
    stamps_of_names,
)

DEFAULT_RATE_HZ: Final = 10.0
_TIMES: Final = "times.txt"
_INSIDE: Final = ("", "data", "images", "image", "img")

_Frames = list[tuple[Path | None, Path | None]]


class _Pairing(NamedTuple):
    """Pairs in order; ``stamps_s`` is None if their times are unknown."""

    pairs: list[tuple[Path, Path]]
    listing: FrameList
    stamps_s: Float64 | None
    how: str
    texts: tuple[Path, ...] = ()


def open_folders(folder: Path, settings: SourceSettings) -> ImageSource:
    """Open plain folders; the description says how the images are paired."""
    found = _pair(folder, settings)
    stamps_s, clock = _times(found, settings)
    first = found.pairs[0][0]
    rig, texts = read_rig(settings, folder, image_size(first, settings), kitti_cameras_of(first))
    truth, note = read_tum_truth(folder, stamps_s)
    return ImageSource(
        name=resolved(folder).name,
        description=f"plain folders, {found.how}{found.listing}{clock}{note}",
        calibration=rig,
        images=[ImageFrame(*both, float(t)) for both, t in zip(found.pairs, stamps_s, strict=True)],
        listing=found.listing,
        truth=truth,
        texts=(*texts, *found.texts),
    )


def find_views(folder: Path, settings: SourceSettings) -> tuple[Path, Path] | None:
    """Return the folders of the left and right images; both are ``folder`` if it contains both."""
    if settings.right is not None:
        left = folder / settings.left if settings.left else folder
        inside = folder / settings.right
        right = inside if inside.is_dir() else Path(settings.right)
        return _with_images(left) or left, _with_images(right) or right
    if settings.left is not None:
        names = [path.name for path in folder.iterdir() if path.is_dir()]
        right_name = next((n for n in partner_names(settings.left) if n in names), None)
        if right_name is not None:
            return find_views(folder, settings.model_copy(update={"right": right_name}))
    inside_of = {path.name: _with_images(path) for path in folder.iterdir() if path.is_dir()}
    holding = {name: inside for name, inside in inside_of.items() if inside is not None}
    pairs = find_partners(holding)
    if pairs:
        return holding[pairs[0][0]], holding[pairs[0][1]]
    if find_partners(path.stem for path in folder.iterdir() if is_image(path)):
        return folder, folder
    return None


def _with_images(folder: Path) -> Path | None:
    """Return the folder itself or its subfolder with the images, or None."""
    places = [folder / name for name in _INSIDE]
    return next((p for p in places if p.is_dir() and any(map(is_image, p.iterdir()))), None)


def _pair(folder: Path, settings: SourceSettings) -> _Pairing:
    if (folder / FRAMES).is_file() and settings.pair_by == "auto":
        return _pair_as_listed(folder, settings)
    views = find_views(folder, settings)
    if views is None:
        what = "folder does not contain images of two cameras"
        expected = "left/ and right/, cam0/ and cam1/, or similar"
        hint = "name them with --left and --right"
        raise SourceError(what, where=folder, expected=expected, hint=hint)
    left, right = _list_both(*views)
    by = settings.pair_by
    timed = () if settings.rate_hz else (folder, views[0])
    listed = next((p / _TIMES for p in timed if (p / _TIMES).is_file()), None)
    found = _pair_by_stamp(left, right, settings, folder) if by in {"auto", "stamp"} else None
    if found is not None:
        return found if listed is None else _with_times(found, listed)
    if by == "stamp":
        raise SourceError("names of the images are not timestamps", where=left[0])
    frames = _by_name(left, right) if by in {"auto", "name"} else None
    how = "by name"
    if frames is None:
        if len(left) != len(right) or by == "name":
            apart = "numbers of left and right images differ"
            what = "left and right images cannot be paired by name" if by == "name" else apart
            got = f"{len(left)} left and {counted(len(right), 'right image')}"
            hint = "give both images of a pair the same name, or their timestamps as names"
            raise SourceError(what, where=folder, got=got, hint=hint)
        frames, how = list(zip(left, right, strict=True)), "by their order"
    pairs, listing = pair_named(frames, settings, folder)
    label = f"{views[0].name} and {views[1].name}" if views[0] != views[1] else "one folder"
    found = _Pairing(pairs, listing, None, f"{label}, paired {how}")
    return found if listed is None else _with_times(found, listed)


def _list_both(left: Path, right: Path) -> tuple[list[Path], list[Path]]:
    if left != right:
        return list_images(left), list_images(right)
    by_stem = {path.stem: path for path in list_images(left)}
    sides = split_sides(by_stem)
    return [by_stem[name] for name in sides[0]], [by_stem[name] for name in sides[1]]


def _pair_as_listed(folder: Path, settings: SourceSettings) -> _Pairing:
    frames = read_frames(folder / FRAMES)
    check_increasing(np.array([frame.left_s for frame in frames]), str(folder / FRAMES))
    pairs, listing = pair_named(
        [(existing(folder / frame.left), existing(folder / frame.right)) for frame in frames],
        settings,
        folder,
    )
    stamps_s = np.array([frames[k].left_s for k in listing.kept])
    return _Pairing(pairs, listing, stamps_s, f"paired according to {FRAMES}", (folder / FRAMES,))


def _pair_by_stamp(
    left: list[Path], right: list[Path], settings: SourceSettings, folder: Path
) -> _Pairing | None:
    """Return pairs by the times in the file names; None unless all names are times."""
    lists = []
    for paths in (left, right):
        stamps_s = stamps_of_names([path.stem for path in paths])
        if stamps_s is None:
            return None
        lists.append(list(zip(stamps_s.tolist(), paths, strict=True)))
    for one in lists:
        check_increasing(np.array([stamp for stamp, _ in one]), str(one[0][1].parent))
    frames, listing = pair_listed(lists, settings, folder)
    pairs = [(frame.left, frame.right) for frame in frames]
    return _Pairing(pairs, listing, stamps_of(frames), "paired by stamps")


def _by_name(left: list[Path], right: list[Path]) -> _Frames | None:
    """Return frames by names equal but for the side; None if most images have no partner."""
    rights = {path.stem: path for path in right}
    frames: _Frames = []
    for path in left:
        names = [path.stem, *partner_names(path.stem)]
        partner = next((rights.pop(name) for name in names if name in rights), None)
        frames.append((path, partner))
    paired = len(right) - len(rights)
    if 2 * paired < max(len(left), len(right)):
        return None
    frames += [(None, path) for path in rights.values()]
    return sorted(frames, key=_place)


def _place(frame: tuple[Path | None, Path | None]) -> list[tuple[int, str]]:
    """Sort key: the last number in a name, which counts frames, else the whole name."""
    stem = (frame[0] or frame[1] or Path()).stem
    numbers = re.findall(r"\d+", stem)
    return [(int(numbers[-1]), "")] if numbers else natural_key(stem)


def _with_times(found: _Pairing, path: Path) -> _Pairing:
    stamps_s = read_times_of_pairs(path, found.listing)
    how = f"{found.how}, times of {_TIMES}"
    return found._replace(stamps_s=stamps_s, how=how, texts=(path,))


def _times(found: _Pairing, settings: SourceSettings) -> tuple[Float64, str]:
    if found.stamps_s is not None and settings.rate_hz is None:
        return found.stamps_s, ""
    rate_hz = settings.rate_hz or DEFAULT_RATE_HZ
    given = "" if settings.rate_hz else ", no times: assumed"
    return np.array(found.listing.kept) / rate_hz, f"{given or ','} {rate_hz:g} Hz"
