"""Which scenes had a part in what the matchers are made of: figures there promise too much.

Every table marks the rows that such scenes are in, by this list alone.
"""

from __future__ import annotations

import re
from typing import Final

MIDD_EVAL3: Final = (
    "ArtL", "Jadeplant", "Motorcycle", "Piano", "Pipes", "Playroom", "Recycle", "Teddy"
)  # fmt: skip
CONSTANTS, WEIGHTS = "¹", "²"
_OURS: Final = {"sad": CONSTANTS, "sgm": CONSTANTS, "fine": CONSTANTS}
#: What evidence and votes ask for was chosen on these, too (names of `benchmarks/pairs.py`).
_PAIRS: Final = ("SceneFlow", "yard", "corner", "wires", "glass", "cave", "shelves", "floor")
_OLDER: Final = ("Books", "Dolls", "Aloe", "Baby1", "Cloth1")
LEGEND: Final = (
    f"{CONSTANTS} scenes that constants were fitted on, {WEIGHTS} that the network was trained on"
)

#: By scene, or by the part of a path that a set of scenes has: the matchers, and what was fitted.
TUNED_ON: Final[dict[str, dict[str, str]]] = {
    **{name: dict(_OURS) for name in (*MIDD_EVAL3, "MiddEval3", *_PAIRS)},
    "2003": {"fine": WEIGHTS},
    "2005": {"sad": CONSTANTS, "fine": WEIGHTS},
    "2006": {"sad": CONSTANTS, "fine": WEIGHTS},
    "Cones": {"fine": WEIGHTS},
    **{name: {"sad": CONSTANTS, "fine": WEIGHTS} for name in _OLDER},
}
_DEFAULT: Final = "fine"  # of what is made of a pair whose matcher is not named


def mark(label: str, scenes: str = "") -> str:
    """Return the marks of a row of a table: empty where nothing was fitted.

    ``label`` names the matcher, in backticks, and the scene; or ``scenes`` those of the table.
    """
    named = re.findall(r"`([\w-]+)`", label)
    matchers = {one for one in named if one in ("sad", "sgm", "fine") or one.startswith("opencv")}
    words = set(re.split(r"[^\w]+", f"{label} {scenes}"))
    parts = [TUNED_ON[word] for word in sorted(words & TUNED_ON.keys())]
    found = {part.get(one, "") for part in parts for one in matchers or {_DEFAULT}}
    return "".join(sorted(found))
