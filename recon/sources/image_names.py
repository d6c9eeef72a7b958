"""Names of the images of two cameras: which mark the left one, and in which order they come."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

# Parts of names that mark the left camera, each with its counterpart for the right one.
SIDES: Final = (
    ("left", "right"),
    ("Left", "Right"),
    ("LEFT", "RIGHT"),
    ("cam0", "cam1"),
    ("cam_0", "cam_1"),
    ("camera0", "camera1"),
    ("camera_0", "camera_1"),
    ("infra1", "infra2"),
    ("image_0", "image_1"),
    ("image_2", "image_3"),
    ("view1", "view5"),
    ("im0", "im1"),
    ("l", "r"),
    ("L", "R"),
    ("0", "1"),
)
_DIGITS: Final = re.compile(r"([0-9]+)")


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key under which 2 comes before 10."""
    # Only ASCII: "²" is a digit to Python, but not a number.
    parts = enumerate(_DIGITS.split(name))
    return [(int(part), "") if at % 2 else (-1, part) for at, part in parts if part]


def partner_names(name: str) -> list[str]:
    """Return possible names of the right camera for a name of the left one, most likely first."""
    found = [other for left, right in SIDES for other in _replaced(name, left, right)]
    return list(dict.fromkeys(found))


def _replaced(name: str, left: str, right: str) -> list[str]:
    """Return a name with the mark of the left side replaced by that of the right one."""
    matches = list(re.finditer(_bounded(left), name))
    if not matches:
        return []
    # All occurrences at once ("left/left_raw"), else only the last ("cam0/cam0_0").
    last = matches[-1]
    whole = re.sub(_bounded(left), right, name)
    return [whole, name[: last.start()] + right + name[last.end() :]]


def _has(name: str, mark: str) -> bool:
    return re.search(_bounded(mark), name) is not None


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
    paired = [{pair[side] for pair in pairs} for side in (0, 1)]
    left, right = (
        [n for n in known if n in paired[k] or (n not in paired[1 - k] and _has(n, mark[k]))]
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
