"""Which left picture belongs to which right one."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from recon.errors import SourceError
from recon.sources.pairing import natural_key
from recon.sources.pictures import PICTURES

_NUMBER: Final = re.compile(r"\d+")

Key = tuple[object, ...]


@dataclass(frozen=True)
class PicturePairs:
    """Pictures of two cameras, paired.

    Attributes:
        pairs: Left and right file of each pair, in natural order.
        by_order: Whether names told nothing, so that the order of the files had to.
    """

    pairs: tuple[tuple[Path, Path], ...]
    by_order: bool


def pair_pictures(left: str | Path, right: str | Path) -> PicturePairs:
    """Find the pictures of two cameras and pair them.

    Pictures belong together whose names are the same but for numbers and words that are the same
    for a whole side, as ``left01.jpg`` and ``right01.jpg`` or ``cam0/17.png`` and ``cam1/17.png``.
    Where the names have nothing in common, and both sides have as many, their order decides.

    Args:
        left: A folder, a picture, or a pattern with ``*``, ``?``, ``[]`` or ``**``.
        right: The same for the right camera.

    Raises:
        SourceError: A side has no pictures, or a picture no partner, or both sides the same files.
    """
    sides = (list_pictures(left), list_pictures(right))
    both = set(sides[0]) & set(sides[1])
    if both:
        raise SourceError(
            "left and right are the same pictures",
            where=sorted(both)[0],
            hint="two patterns or folders that have no file in common",
        )
    for keyed in (_by_name, _by_numbers):
        keys = [keyed(side) for side in sides]
        if set(keys[0]) & set(keys[1]):
            return PicturePairs(_match(keys[0], keys[1]), by_order=False)
    if len(sides[0]) != len(sides[1]):
        raise SourceError(
            "pictures do not pair up",
            where=left,
            got=f"{len(sides[0])} left, {len(sides[1])} right",
            expected="as many left as right, or names that tell the pairs",
        )
    return PicturePairs(tuple(zip(*sides, strict=True)), by_order=len(sides[0]) > 1)


def list_pictures(where: str | Path) -> list[Path]:
    """The pictures of a folder or pattern, 2 before 10.

    Raises:
        SourceError: There are none.
    """
    folder = Path(where)
    found = (
        folder.iterdir()
        if folder.is_dir()
        else (Path(name) for name in glob.glob(str(where), recursive=True))  # noqa: PTH207
    )
    pictures = [path for path in found if path.suffix.lower() in PICTURES and path.is_file()]
    if not pictures:
        raise SourceError(
            "no pictures there",
            where=where,
            expected=", ".join(sorted(PICTURES)),
            hint='put patterns in quotes: "left*.png"',
        )
    return sorted(pictures, key=lambda path: natural_key(path.name))


def _by_name(side: Sequence[Path]) -> dict[Key, Path]:
    return {(path.stem,): path for path in side}


def _by_numbers(side: Sequence[Path]) -> dict[Key, Path]:
    """Pictures by those numbers in their names that are not the same for the whole side."""
    numbers = [tuple(int(word) for word in _NUMBER.findall(path.stem)) for path in side]
    if len({len(each) for each in numbers}) != 1:
        return {}
    varying = [k for k in range(len(numbers[0])) if len({each[k] for each in numbers}) > 1]
    keys = [tuple(each[k] for k in varying) for each in numbers]
    if not varying or len(set(keys)) != len(keys):
        return {}
    return dict(zip(keys, side, strict=True))


def _match(left: dict[Key, Path], right: dict[Key, Path]) -> tuple[tuple[Path, Path], ...]:
    lonely = [
        here[key]
        for here, there in ((left, right), (right, left))
        for key in here
        if key not in there
    ]
    if lonely:
        names = ", ".join(path.name for path in lonely[:3]) + (" …" if len(lonely) > 3 else "")
        raise SourceError(
            "pictures do not pair up: these have no partner",
            where=lonely[0].parent,
            got=names,
            hint="move them away, or correct their names",
        )
    return tuple((path, right[key]) for key, path in left.items())
