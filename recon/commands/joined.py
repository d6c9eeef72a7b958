"""A run that puts several drives into one map: links them, places them, and makes the products."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig, check_changes, run_settings
from recon.commands.export import REMADE
from recon.commands.map_options import MapOptions
from recon.core.errors import ReconError
from recon.export.joined import JoinedMap, export_sessions, joined_figures, joined_warnings
from recon.export.make import make
from recon.export.product import Order
from recon.map.sessions.copying import check_session, copy_sessions, read_all
from recon.map.sessions.joining import join_new
from recon.map.sessions.measured import Survey, hold
from recon.map.sessions.placed import place_map
from recon.map.store.map_file import MAP_FILE
from recon.map.verbs import Map
from recon.report.map_page import write_joined_page
from recon.run.finished import open_run
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

    The folder appears, or takes the place of an earlier run, in one step when all is done.

    Args:
        options: Folder, threads, mesh and progress of the run.
        settings: Its settings.
        fill: Puts the drives into its map.
        inputs: The files that are read.
        replaced: The run whose place it takes; None = it is a new one.
        survey: Measured positions that the paths are bent to run through; None = no more than the
            drives have already.

    Returns:
        The figures of ``summary.json``.
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
        joined = JoinedMap(map_, made)
        summary = {**joined_figures(joined), "warnings": [*left_out, *joined_warnings(joined)]}
        export_sessions(joined, run)
        with run.report(summary):
            write_joined_page(joined, summary, run)
        T_map_world = map_.first.T_map_world.tolist()
        map_.close()
        run.finish(
            summary,
            source=", ".join(session["name"] for session in summary["sessions"]),
            inputs=inputs,
            record={"T_map_world": T_map_world},
        )
    return summary


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
    open_run(folder)
    ran = run_settings(folder)
    if config is not None:
        check_changes(ran, config, _REMADE)
    return config or ran
