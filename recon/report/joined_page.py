"""The report of a map of several drives."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.core.geometry.se3 import apply
from recon.export.joined import JoinedMap
from recon.report.drive_figures import grid_figure, seen_from_above
from recon.report.page import write_page
from recon.report.scene import Scene, plot_scene
from recon.run.directory import RunDirectory


def write_joined_page(joined: JoinedMap, summary: dict[str, Any], run: RunDirectory) -> None:
    """Write ``report.html`` of a map of several drives: all paths on one grid."""
    T_map_world, made = joined.map.first.T_map_world, joined.made
    named = {f"session {number}": path for number, path in joined.paths.items()}
    from_above = {name: seen_from_above(path, T_map_world) for name, path in named.items()}
    ways = [(name, np.asarray(apply(T_map_world, p.positions_m))) for name, p in named.items()]
    write_page(
        "joined",
        run,
        run=summary,
        warnings=summary["warnings"],
        grid=grid_figure(made.grid, from_above),
        resolution_m=made.grid.resolution_m,
        view=plot_scene(Scene(np.eye(4), made.cloud, made.mesh, ways)),
    )
