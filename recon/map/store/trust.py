"""Which frames of a map have a place in it, and what is to be said of the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Bool
from recon.map.store.links import Link
from recon.map.store.session import Session
from recon.odometry.health import doubt_about, name_frames, stretches

_Stretch = tuple[int, int]
"""Number of a drive, and of a stretch of it."""

_SURVEY: Final[_Stretch] = (-1, -1)
_FEWEST_FIXES: Final = 2
"""Measured positions that say where a stretch is, and which way it goes."""


def placed_frames(sessions: Sequence[Session], links: Sequence[Link]) -> dict[int, Bool]:
    """Return by number of the drive bool (N,), which frames have a place in the map.

    Those whose pose is to be trusted; in a map of several drives only those of stretches that
    loops, links or measured positions hold to the longest one of the first drive. Behind a lost
    pose odometry guesses, and a guess does not enter what other drives saw.

    Args:
        sessions: The drives that share axes.
        links: The links between them.
    """
    of = {session.number: stretches(session.health) for session in sessions}
    if len(sessions) < 2:
        return {number: stretch >= 0 for number, stretch in of.items()}
    ties, first = [*_ties(sessions, links, of)], sessions[0].number
    held = {(first, int(np.bincount(of[first] + 1)[1:].argmax()))}
    while more := {b for tie in ties for a, b in (tie, tie[::-1]) if a in held} - held:
        held |= more
    return {
        number: (stretch >= 0) & np.isin(stretch, [s for drive, s in held if drive == number])
        for number, stretch in of.items()
    }


def doubts_of_drives(sessions: Sequence[Session], placed: Mapping[int, Bool]) -> list[str]:
    """Return lines of poses that are not to be trusted, and of what has no place after them.

    Args:
        sessions: The drives that share axes.
        placed: Which of their frames have a place, see `placed_frames`.
    """
    lines = []
    for session in sessions:
        of = f"session {session.number} ({session.info.source}): " if len(sessions) > 1 else ""
        lines += [of + line for line in doubt_about(session.health)]
        trusted = session.trusted
        apart = np.flatnonzero(trusted & ~placed[session.number]).tolist()
        if apart:
            why = "follow a lost pose, and nothing that was seen again says where"
            left_out = "not in cloud, grid, OctoMap and mesh, nor to be recognised"
            lines.append(f"{of}{name_frames(apart)} {why}: {left_out}")
    return lines


def _ties(
    sessions: Sequence[Session], links: Sequence[Link], of: Mapping[int, NDArray[np.int64]]
) -> Iterator[tuple[_Stretch, _Stretch]]:
    """Yield pairs of stretches that loops, links and measured positions hold together."""

    def stretch(number: int, frame: int) -> _Stretch:
        return number, int(of[number][frame])

    for session in sessions:
        number = session.number
        for loop in session.loops.get("closed", ()):
            yield stretch(number, loop["first"]), stretch(number, loop["last"])
        measured, counts = np.unique(of[number][session.fixes.frames], return_counts=True)
        for one in measured[(measured >= 0) & (counts >= _FEWEST_FIXES)].tolist():
            yield (number, one), _SURVEY
    for link in links:
        if link.kept and set(link.sessions) <= set(of):
            one, other = link.sessions
            yield stretch(one, link.loop.first), stretch(other, link.loop.last)
