"""`recon view`: maps in the browser, of finished runs and of those that are being made."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from recon.core.errors import EvaluationError
from recon.core.text import counted, with_unit
from recon.io.files import read_text, reading
from recon.io.models.ply import read_ply
from recon.map.sessions.measured import Survey
from recon.map.store.map_file import file_of_map
from recon.map.store.records import check_format, connect
from recon.report.scene import Scene
from recon.run.directory import RECORD, RECORD_BYTES, STARTED, state_folder
from recon.run.finished import CLOUD, command_of_map, figure_of, states_of
from recon.run.run import SUMMARY
from recon.view.server import Viewer, cut

_TURN_S: Final = 0.2  # between two looks at whether there is anything new
_TURNS: Final = 25  # that are waited for a browser
_FORMATS: Final = {int: "{:,}".format, float: lambda v: f"{float(f'{v:.3g}'):,g}"}
_FIGURES: Final = {
    "frames": "Frames", "path_length_m": "Path", "points": "Points in the map",
    "frames_not_trusted": "Frames not trusted", "expected_drift_percent": "Expected drift",
    "expected_drift_rig_percent": "Drift due to the rig",
}  # fmt: skip


def run_view(
    runs: Sequence[Path],
    port: int,
    announce: Callable[[str], object],
    stopped: Callable[[], bool],
    survey: Survey | None = None,
) -> str:
    """Show the maps of runs, each in its own axes, until ``stopped``: what `recon view` does.

    ``port`` is of this machine, for itself alone; ``announce`` gets the address, which is returned.
    Control points of a ``survey`` can be clicked in keyframes. `ReconError`: a run has no map or a
    damaged one, viser is missing, the port is taken, or the survey has no control points.
    """
    if survey is not None and survey.control is None:
        what, hint = "positions along a drive cannot be clicked", "give a list of control points"
        got = counted(len(survey.found.times_s), "position")
        raise EvaluationError(what, where=survey.positions, got=got, hint=hint)
    shown = [(map_of(run), run) for run in runs]
    for run, _ in shown:
        if not (state_folder(run) / STARTED).is_file():
            _, path = command_of_map(run), file_of_map(run)  # refuses what made no map
            with reading(path), closing(connect(path, read_only=True)) as database:
                check_format(database, path)
    with closing(Viewer(port)) as viewer:
        announce(viewer.url)
        coming = [(run, _scenes(folder, viewer, run, survey)) for folder, run in shown]
        while not stopped():
            for run, scenes in coming:
                if (new := next(scenes, None)) is not None:
                    viewer.show(run, new)
            viewer.serve(_TURN_S)
    return viewer.url


def map_of(run: Path) -> Path:
    """Return the folder of the map of a run: of one that located a drive, that which it was in."""
    table = states_of(run)
    if not table.is_file():
        return run
    with reading(summary := table.with_name(SUMMARY)):
        named = Path(json.loads(read_text(summary, RECORD_BYTES))["map_run"])
    return named if named.is_dir() else named.parent.parent  # its file


def _scenes(
    run: Path, viewer: Viewer, asked: Path, survey: Survey | None
) -> Iterator[Scene | None]:
    path, busy = state_folder(run) / STARTED, state_folder(asked).is_dir
    if not (growing := path.is_file()) and not busy():
        yield read_products(run)
    # What opens maps takes seconds to load, and would slow down the browser that begins; beside a
    # map that grows nothing is done for nobody.
    turns = 0
    while not viewer.looked_at and (turns < _TURNS or busy()):
        turns += 1
        yield None
    from recon.view.follow import finish, follow_located, grow  # noqa: PLC0415

    if growing:
        yield from grow(run, path)
    if not growing or (run / RECORD).is_file():  # else it was given up
        scenes = finish(run, read_products(run), survey)
        yield from scenes if asked == run else follow_located(scenes, asked)


def read_products(run: Path) -> Scene:
    """Return points and figures of a finished run by its files, which takes a moment."""
    voxel_m = figure_of(run, "voxel_m")
    with reading(run / SUMMARY):
        summary = json.loads(read_text(run / SUMMARY, RECORD_BYTES))
        known = {n: v for n in _FIGURES if type(v := summary.get(n)) in _FORMATS}
        lines = [f"{_FIGURES[n]}: {with_unit(_FORMATS[type(v)](v), n)}" for n, v in known.items()]
    cloud, spacing_m = run / CLOUD, voxel_m or 0.1  # merged: unsaid
    points = cut(read_ply(cloud), spacing_m) if cloud.is_file() else ()
    return Scene(points, lines=[str(run), *lines], spacing_m=spacing_m)
