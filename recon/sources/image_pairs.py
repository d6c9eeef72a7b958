"""Pairs the image files of two cameras by their names."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from recon.core.errors import SourceError
from recon.core.words import counted
from recon.sources.image_names import natural_key
from recon.sources.images import IMAGES

_NUMBER: Final = re.compile(r"[0-9]+")

Key = tuple[object, ...]


@dataclass(frozen=True)
class ImagePairs:
    """Images of two cameras, paired.

    Attributes:
        pairs: Left and right file of each pair, in natural order.
        by_order: Whether files were paired by order, as their names gave no clue.
        lonely: Files that were left out since they have no partner.
    """

    pairs: tuple[tuple[Path, Path], ...]
    by_order: bool
    lonely: tuple[Path, ...] = ()


def pair_images(left: str | Path, right: str | Path) -> ImagePairs:
    """Find the images of two cameras and pair them.

    Names match if they are equal apart from words and constant numbers of each side, such as
    ``left01.jpg`` and ``right01.jpg`` or ``cam0/17.png`` and ``cam1/17.png``. If no names match
    and both sides have as many images, they are paired by order. Files without a partner are left
    out.

    Args:
        left: A folder, an image, or a pattern with ``*``, ``?``, ``[]`` or ``**``.
        right: The same for the right camera.
    """
    sides = (find_images(left), find_images(right))
    both = set(sides[0]) & set(sides[1])
    if both:
        raise SourceError(
            "left and right are the same images",
            where=sorted(both)[0],
            hint="give two patterns or folders without a common file",
        )
    for keyed in (_by_name, _by_numbers):
        keys = [keyed(side) for side in sides]
        if set(keys[0]) & set(keys[1]):
            return _match(sides, keys[0], keys[1])
    if len(sides[0]) != len(sides[1]):
        raise SourceError(
            "images do not pair up",
            where=left,
            got=f"{len(sides[0])} left, {len(sides[1])} right",
            expected="as many left as right, or names that identify the pairs",
        )
    return ImagePairs(tuple(zip(*sides, strict=True)), by_order=len(sides[0]) > 1)


def find_images(where: str | Path) -> list[Path]:
    """Return the images of a folder or pattern in natural order: 2 before 10."""
    folder = Path(where)
    found = (
        folder.iterdir()
        if folder.is_dir()
        else (Path(name) for name in glob.glob(str(where), recursive=True))  # noqa: PTH207
    )
    images = [path for path in found if path.suffix.lower() in IMAGES and path.is_file()]
    if not images:
        raise SourceError(
            "no images found",
            where=where,
            expected=", ".join(sorted(IMAGES)),
            hint='put patterns in quotes: "left*.png"',
        )
    return sorted(images, key=lambda path: natural_key(path.name))


def _by_name(side: Sequence[Path]) -> dict[Key, Path]:
    return {(path.stem,): path for path in side}


def _by_numbers(side: Sequence[Path]) -> dict[Key, Path]:
    """Return images by those numbers in their names that vary within the side.

    Names with more or fewer numbers than most are left out.
    """
    numbers = {path: tuple(int(word) for word in _NUMBER.findall(path.stem)) for path in side}
    usual = Counter(len(each) for each in numbers.values()).most_common(1)[0][0]
    numbers = {path: each for path, each in numbers.items() if len(each) == usual}
    varying = [k for k in range(usual) if len({each[k] for each in numbers.values()}) > 1]
    keyed: dict[Key, Path] = {
        tuple(each[k] for k in varying): path for path, each in numbers.items()
    }
    return keyed if varying and len(keyed) == len(numbers) else {}


def _match(
    sides: Sequence[Sequence[Path]], left: dict[Key, Path], right: dict[Key, Path]
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
