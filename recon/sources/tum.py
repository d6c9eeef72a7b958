"""Drives with lists of images and their times, as in the TUM benchmarks.

::

    folder/
      left.txt right.txt        time [s] and file, one line per image (or cam0.txt cam1.txt …)
      left/1305031102.175304.png …
      groundtruth.txt           optional: t tx ty tz qx qy qz qw of the left camera
      calib.txt                 or any other supported calibration file
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.core.errors import SourceError
from recon.io.files import resolved
from recon.sources.calibration import read_rig
from recon.sources.image_names import find_partners
from recon.sources.images import ImageSource, image_size, is_image, pair_listed
from recon.sources.settings import SourceSettings
from recon.sources.stamps import check_increasing, check_seconds
from recon.sources.times import read_stamped_names, read_tum_truth


def open_tum(folder: Path, settings: SourceSettings) -> ImageSource:
    """Open a drive with two lists; its images are paired by timestamp."""
    paths = _find_lists(folder, settings)
    lists = [_read_list(path) for path in paths]
    frames, listing = pair_listed(lists, settings, folder)
    rig, texts = read_rig(settings, folder, image_size(frames[0].left, settings))
    truth, note = read_tum_truth(folder, np.array([frame.timestamp_s for frame in frames]))
    return ImageSource(
        name=resolved(folder).name,
        description=f"TUM drive, {paths[0].name} and {paths[1].name}, "
        f"paired by stamps{listing}{note}",
        calibration=rig,
        images=frames,
        listing=listing,
        truth=truth,
        texts=(*texts, *paths),
    )


def list_files(folder: Path) -> list[tuple[str, str]]:
    """Return names (left, right) of the text files in a folder that list images."""
    names = [path.name for path in folder.iterdir() if path.suffix == ".txt" and _lists(path)]
    return find_partners(names)


def _lists(path: Path) -> bool:
    """Return whether a file is a list, by its first entry: a number, then the name of an image."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        words = next((line.split() for line in lines if line.strip() and line[0] != "#"), [])
    return len(words) >= 2 and is_image(Path(words[1]))


def _find_lists(folder: Path, settings: SourceSettings) -> tuple[Path, Path]:
    if settings.left and settings.right:
        return folder / settings.left, folder / settings.right
    found = list_files(folder)
    if not found:
        raise SourceError(
            "folder has no image lists of two cameras",
            where=folder,
            expected="left.txt and right.txt, or similar",
            hint="name them with --left and --right",
        )
    return folder / found[0][0], folder / found[0][1]


def _read_list(path: Path) -> list[tuple[float, Path]]:
    listed = [(stamp, path.parent / name) for stamp, name in read_stamped_names(path)]
    stamps_s = np.array([stamp for stamp, _ in listed])
    check_increasing(stamps_s, str(path))
    check_seconds(stamps_s, path)
    return listed
