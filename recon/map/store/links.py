"""Links between the drives of a map: places that two of them saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.geometry.se3 import check_rigid
from recon.map.store.values import value_in
from recon.places.loop import Loop

LINKS: Final = "links"


def loop_in(tree: Mapping[str, Any]) -> Loop:
    """Return a loop of a tree of its fields."""
    loop = value_in(Loop, tree)
    check_rigid("T_first_last", loop.T_first_last)
    if not np.isfinite(loop.information).all() or np.linalg.eigvalsh(loop.information)[0] < 0:
        raise FormatError("a loop of the map has an impossible information")
    return loop


@dataclass(frozen=True, eq=False)
class Link:
    """A place that two drives saw.

    Attributes:
        sessions: Numbers of the two drives.
        loop: ``first`` is a frame of the first drive, ``last`` one of the second.
        kept: Whether the pose graph believes it.
    """

    sessions: tuple[int, int]
    loop: Loop
    kept: bool = True

    def between(self, one: int, other: int) -> Link:
        """Return the link with other numbers of its drives."""
        return replace(self, sessions=(one, other))

    def to_tree(self) -> dict[str, Any]:
        """Return everything, as a tree of arrays and plain values."""
        return {"sessions": self.sessions, "loop": asdict(self.loop), "kept": self.kept}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> Link:
        """Return what `to_tree` gave."""
        one, other = tree["sessions"]
        if not (isinstance(one, int) and isinstance(other, int) and one != other):
            raise FormatError("a link of the map is not between two drives", got=tree["sessions"])
        return cls((one, other), loop_in(tree["loop"]), bool(tree["kept"]))
