"""A map of several drives beside its products: figures, warnings, and the paths as files."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recon.core.values import Trajectory
from recon.export.make import Products
from recon.io.trajectory import write_kitti_poses, write_tum
from recon.map.sessions.joining import doubts_of_lengths
from recon.map.sessions.measured import doubts_of_positions, misfit_rms_m
from recon.map.verbs import Map
from recon.run.directory import RunDirectory


@dataclass(frozen=True, eq=False)
class JoinedMap:
    """A map of several drives, whose products are written.

    Attributes:
        map: The map.
        made: The products.
    """

    map: Map
    made: Products

    @property
    def paths(self) -> dict[int, Trajectory]:
        """The path of each linked drive by its number, in the world of the first."""
        return {
            session.number: replace(
                session.trajectory,
                T_world_camera=self.map.T_world_session(session)
                @ session.trajectory.T_world_camera,
            )
            for session in self.map.linked
        }


def joined_figures(joined: JoinedMap) -> dict[str, Any]:
    """Return the figures for ``summary.json``."""
    map_ = joined.map
    placed = map_.placed
    kept = [link for link in map_.links if link.kept]
    pairs = Counter("-".join(map(str, link.sessions)) for link in kept)
    return {
        "frames": sum(map(len, map_.linked)),
        "path_length_m": sum(path.path_length_m for path in joined.paths.values()),
        "sessions": [
            {
                "number": session.number,
                "name": session.info.source,
                "frames": len(session),
                "length_m": session.trajectory.path_length_m,
                "linked": session.number in placed,
                "frames_not_trusted": int((~session.trusted).sum()),
                "frames_placed": int(placed.get(session.number, np.zeros(0)).sum()),
                "positions": len(session.fixes),
            }
            for session in map_.sessions
        ],
        "links": {"count": len(kept), "refused": len(map_.links) - len(kept), "pairs": dict(pairs)},
        "positions_misfit_rms_m": misfit_rms_m(map_),
        "faces": 0,
        **joined.made.figures,
        "T_map_world": map_.first.T_map_world.tolist(),
    }


def joined_warnings(joined: JoinedMap) -> list[str]:
    """Return what the user should know: drives apart; doubtful poses, lengths, and positions."""
    linked = joined.map.linked
    apart = [session for session in joined.map.sessions if session not in linked]
    names = ", ".join(f"{session.number} ({session.info.source})" for session in apart)
    what = "shares no verified place" if len(apart) == 1 else "share no verified place"
    text = f"session {names} {what} with session {linked[0].number}: kept in the map, but not in "
    return [
        *joined.map.doubts,
        *([text + "cloud, grid, OctoMap and mesh"] if apart else ()),
        *doubts_of_lengths(joined.map),
        *doubts_of_positions(joined.map),
        *joined.made.warnings,
    ]


def export_sessions(joined: JoinedMap, run: RunDirectory) -> None:
    """Write ``sessions/<number>/trajectory_*.txt`` of the linked drives, in the map's world."""
    for number, path in joined.paths.items():
        write_kitti_poses(run.path(f"sessions/{number}/trajectory_kitti.txt"), path)
        write_tum(run.path(f"sessions/{number}/trajectory_tum.txt"), path)
