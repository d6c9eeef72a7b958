"""`recon map --workers`: a long drive is cut, its pieces are mapped by jobs, and joined."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from recon.commands.config import ReconConfig
from recon.commands.map_options import MapOptions
from recon.commands.map_summary import PieceSummary
from recon.core.errors import ClusterError, RegistrationError, SettingsError
from recon.io.atomic import write_text
from recon.io.cameras.calibration import read_recon_calibration, write_recon_calibration
from recon.io.files import read_text, reading, resolved
from recon.map.drive.drive import Workspace
from recon.map.drive.drive_odometry import odometry_of
from recon.map.drive.sequence import map_sequence
from recon.map.map import Map
from recon.map.sessions.copying import join_parts, keep_map
from recon.map.store.map_file import MAP_FILE
from recon.run.batch.cluster import BatchOptions
from recon.run.batch.job import Job
from recon.run.batch.results import JobResult, work_off
from recon.run.run import Run
from recon.sources.source import SourcePart, StereoSource

LEAD: Final = 20
"""Frames that a piece has in common with the one before: there its odometry gets going."""
_LEAST: Final = 2 * LEAD  # frames of the shortest piece, without its lead
_MOST: Final = 1000
"""Frames of the longest piece: what is lost with a worker, and the time that others wait for it."""
_PLAN: Final = "pieces.json"
_RIG: Final = "pieces_rig.yaml"  # the calibration that all pieces are mapped with
_PLAN_BYTES: Final = 1 << 26


class Piece(NamedTuple):
    """A piece of a drive: its first frame, the one behind its last, how many the one before has."""

    first: int
    last: int
    lead: int = 0


def cut_drive(frames: int, workers: int) -> list[Piece]:
    """Cut a drive into pieces of about the same length, several for each worker if it is long.

    A drive that is too short for so many pieces gets fewer.
    """
    rounds = math.ceil(frames / (workers * _MOST))
    count = max(1, min(workers * rounds, frames // _LEAST))
    ends = [round(frames * number / count) for number in range(count + 1)]
    return [
        Piece(begin - LEAD, end, LEAD) if begin else Piece(0, end) for begin, end in pairwise(ends)
    ]


def begun_in_pieces(run: Run) -> bool:
    """Return whether a run that is resumed was begun in pieces."""
    return run.state(_PLAN).is_file()


def map_pieces(
    source: StereoSource, config: ReconConfig, options: MapOptions, run: Run, map_: Map
) -> None:
    """Map a drive in pieces on workers and join them, unless the map of the run has it already.

    To close its loops is left to `map_sequence`, for which it is a drive resumed at its end.
    """
    plan, session = run.state(_PLAN), map_.session()
    spread = options.workers or BatchOptions()
    if len(session) and not plan.is_file():
        raise SettingsError("the run was begun in one piece", hint="resume it without --workers")
    _refuse_what_does_not_combine(config, options)
    if len(session):
        return
    began, threads = time.perf_counter(), spread.threads_of(options.threads)
    folder = resolved(plan).with_suffix("")
    with run.stage("pieces"), spread.connect() as cluster:
        pieces = read_plan(plan)[0] if plan.is_file() else cut_drive(len(source), cluster.at_once)
        # Again for a run that is resumed, which may have another memory limit.
        write_recon_calibration(run.state(_RIG), source.calibration)
        planned = (pieces, options.arguments, config.model_dump(mode="json"))
        write_text(plan, json.dumps(planned, indent=1))
        jobs = [piece_job(plan, number, piece, threads) for number, piece in enumerate(pieces)]
        ended = work_off(jobs, folder, cluster, spread, "pieces")
        found = {one.job.name: _checked(one) for one in ended}
    with run.stage("join"):
        join_parts(map_, _opened(folder, pieces), config)
    state = {"odometry": odometry_of(config, source, None, None, None).state(), "builder": None}
    done = [{**piece._asdict(), **found[str(number)]} for number, piece in enumerate(pieces)]
    session.set_state({"mapper": state, "seconds": time.perf_counter() - began, "pieces": done})
    map_.commit()
    shutil.rmtree(folder, ignore_errors=True)


def pieces_of(run: Run, map_: Map) -> dict[str, Any]:
    """Return what the record of a run has of its pieces; nothing if there were none."""
    state = map_.session().state() if begun_in_pieces(run) else None
    return {} if state is None else {"pieces": state["pieces"]}


def read_plan(plan: Path) -> tuple[list[Piece], dict[str, Any], dict[str, Any]]:
    """Read the pieces of a run, the arguments of its command line, and its settings."""
    with reading(plan):
        pieces, arguments, config = json.loads(read_text(plan, _PLAN_BYTES))
        return [Piece(*piece) for piece in pieces], arguments, config


def run_piece(plan: Path, number: int, options: MapOptions) -> PieceSummary:
    """Map a piece of a drive, or go on with it: what the jobs do."""
    pieces, arguments, settings = read_plan(plan)
    # Loops are looked for in the whole drive.
    config = ReconConfig.parse(settings, where=str(plan))
    loops = config.loops.model_copy(update={"enabled": False})
    config = config.model_copy(update={"loops": loops})
    source, _ = MapOptions.of(arguments).open(config)
    source = source.with_calibration(read_recon_calibration(plan.with_name(_RIG)))
    part = SourcePart(source, *pieces[number])
    with options.run(config) as run, options.begin(run, part, config) as map_:
        work = Workspace(map_, run.watch, run.threads)
        map_sequence(part, config, workspace=work)
        keep_map(map_, run.path(MAP_FILE))
        return run.finish(PieceSummary(frames=len(part)), source=part.name, inputs=())


def _refuse_what_does_not_combine(config: ReconConfig, options: MapOptions) -> None:
    if options.known_poses is not None or options.prior is not None:
        what = "a drive with --poses or --prior is mapped in one piece"
        raise SettingsError(what, hint="drop --workers and --scheduler")
    if not config.occupancy.keep_rays:
        what = "pieces are joined by their rays"
        raise SettingsError(what, hint="drop occupancy.keep_rays=false")
    if not options.arguments.get("source"):
        what = "workers open the source by its path"
        raise SettingsError(what, hint="map a file or folder")


def piece_job(plan: Path, number: int, piece: Piece, threads: int | None) -> Job:
    """Return what a worker does for a piece: it runs `run_piece`."""
    limit = () if threads is None else ("--threads", str(threads))
    frames = f"{piece.first} to {piece.last - 1}"
    words = ("piece", str(resolved(plan)), str(number), *limit, "--json", "--verbose")
    return Job(str(number), "piece", frames, words, writes=True, folder=str(Path.cwd()))


def _checked(one: JobResult) -> dict[str, Any]:
    """Return where a piece was mapped, and what it took."""
    if not one.ok:
        kind = RegistrationError if one.last.state == "failed" else ClusterError
        raise kind(f"frames {one.job.source} cannot be mapped", got=one.last.error)
    taken = {name: one.figures[name] for name in ("seconds", "peak_memory_mb")}
    return {"tries": one.last.tries, "worker": one.last.worker, **taken}


def _opened(folder: Path, pieces: Sequence[Piece]) -> Iterator[tuple[Map, int]]:
    """Yield the map of each piece, opened one at a time, and the frames of its lead."""
    for number, piece in enumerate(pieces):
        with Map.open(folder / str(number)) as map_:
            yield map_, piece.lead
