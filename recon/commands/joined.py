"""A run that puts several drives into one map: links them, places them, and makes the products."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.commands.config import ReconConfig, check_changes, run_settings
from recon.commands.export import REMADE
from recon.commands.map_options import MapOptions
from recon.core.errors import ReconError
from recon.export.make import make
from recon.export.product import Order
from recon.export.trajectories import export_sessions
from recon.map.map import Map
from recon.map.sessions.copying import check_session, copy_sessions, read_all
from recon.map.sessions.joining import doubts_of_lengths, join_new
from recon.map.sessions.measured import Survey, doubts_of_positions, hold, misfit_rms_m
from recon.map.sessions.placed import place_map
from recon.map.store.map_file import MAP_FILE
from recon.report.map_page import write_joined_page
from recon.run.finished import command_of_map
from recon.run.run import Run, WholeRun

_REMADE: Final = (*REMADE, "mesh", "memory")
"""Sections of the configuration that may differ from those of the first run."""
Fill = Callable[[Run, Map], Sequence[int]]
"""Puts drives into the empty map of a run; gives the numbers of those that are new in it."""


def make_joined(
    options: MapOptions,
    settings: ReconConfig,
    fill: Fill,
    inputs: Sequence[Path],
    replaced: Path | None = None,
    survey: Survey | None = None,
) -> dict[str, Any]:
    """Fill the map of a run, link and place its drives, and make its products and its report.

    It may take the place of a run; positions may be measured beside those that drives have already.
    """
    with (
        WholeRun(
            options.command,
            replaced or options.out,
            settings,
            threads=options.threads,
            progress=options.progress,
        ) as run,
        Map.create(run.path(MAP_FILE), cache_bytes=settings.memory.cache_bytes) as map_,
        _damage_named(map_, inputs),
    ):
        new = fill(run, map_)
        left_out = [] if survey is None else hold(map_, survey)
        with run.stage("links"):
            join_new(map_, new)
        map_.commit()
        with run.stage("map"):
            placed = place_map(map_, settings, run.threads)
        made = make(Order(map_, placed, run, settings.mesh), options.products)
        T_map_world = map_.first.T_map_world.tolist()
        warnings = [*left_out, *_warnings(map_), *made.warnings]
        summary = {**_figures(map_), **made.figures, "T_map_world": T_map_world}
        summary["warnings"] = warnings
        export_sessions(map_, run)
        with run.report(summary):
            write_joined_page(map_, made, summary, run)
        map_.close()
        run.finish(
            summary,
            source=", ".join(session["name"] for session in summary["sessions"]),
            inputs=inputs,
            record={"T_map_world": T_map_world},
        )
    return summary


def _figures(map_: Map) -> dict[str, Any]:
    """Return the figures of the drives and their links."""
    placed = map_.placed
    kept = [link for link in map_.links if link.kept]
    pairs = Counter("-".join(map(str, link.sessions)) for link in kept)
    return {
        "frames": sum(map(len, map_.linked)),
        "path_length_m": sum(path.path_length_m for path in map_.paths.values()),
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
    }


def _warnings(map_: Map) -> list[str]:
    """Return what the user should know: drives apart; doubtful poses, lengths, and positions."""
    linked = map_.linked
    apart = [session for session in map_.sessions if session not in linked]
    names = ", ".join(f"{session.number} ({session.info.source})" for session in apart)
    what = "shares no verified place" if len(apart) == 1 else "share no verified place"
    text = f"session {names} {what} with session {linked[0].number}: kept in the map, but not in "
    return [
        *map_.doubts,
        *([text + "cloud, grid, OctoMap and mesh"] if apart else ()),
        *doubts_of_lengths(map_),
        *doubts_of_positions(map_),
    ]


@contextmanager
def _damage_named(map_: Map, inputs: Sequence[Path]) -> Iterator[None]:
    """Name the map that a damaged record came from, not the new one, which does not stay."""
    try:
        yield
    except ReconError as error:
        if str(error.where) == map_.store.name:
            for file in inputs:
                if file.match(MAP_FILE):
                    with closing(Map.open(file)) as read:
                        read_all(read)
        raise


def copied(file: Path, map_: Map, settings: ReconConfig) -> list[int]:
    """Copy the drives of a finished map into another; their numbers."""
    with closing(Map.open(file)) as other:
        for session in other.sessions:
            check_session(session, settings)
        return copy_sessions(other, map_)


def joined_settings(folder: Path, config: ReconConfig | None) -> ReconConfig:
    """Return the settings of a finished run, or those with changes where they have an effect."""
    command_of_map(folder)
    ran = run_settings(folder)
    if config is not None:
        check_changes(ran, config, _REMADE)
    return config or ran
