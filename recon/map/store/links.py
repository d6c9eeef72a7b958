"""Links between the drives of a map: places that two of them saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from recon.core.errors import FormatError
from recon.places.loop import Loop

LINKS: Final = "links"


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
        """Return what `to_tree` gave.

        Raises:
            FormatError: It is not between two drives; other exceptions where it is no such tree.
        """
        one, other = tree["sessions"]
        if not (isinstance(one, int) and isinstance(other, int) and one != other):
            raise FormatError("a link of the map is not between two drives", got=tree["sessions"])
        return cls((one, other), Loop(**tree["loop"]), bool(tree["kept"]))
