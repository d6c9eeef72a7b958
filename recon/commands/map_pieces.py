"""`recon map --workers`: a long drive in pieces, each mapped by a process of its own somewhere."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig
from recon.commands.map_options import MapOptions
from recon.commands.piece import PiecePlan, piece_job, read_plan, write_plan
from recon.core.errors import ClusterError, RegistrationError, SettingsError
from recon.map.drive.pieces import Piece, cut_drive, join_pieces, joined_drive
from recon.map.drive.sequence import MappedSequence
from recon.map.drive.workspace import Workspace
from recon.map.store.map import Map
from recon.run.batch.cluster import Cluster, connect
from recon.run.batch.figures import result_of
from recon.run.batch.plan import Limits
from recon.run.batch.work import BatchOptions, JobStep
from recon.run.run import Run
from recon.sources.protocol import StereoSource

_PLAN: Final = "pieces.json"


def begun_in_pieces(run: Run) -> bool:
    """Return whether a run that is resumed was begun in pieces."""
    return run.state(_PLAN).is_file()


def map_in_pieces(
    source: StereoSource, config: ReconConfig, options: MapOptions, run: Run, map_: Map
) -> MappedSequence:
    """Map a drive in pieces on workers, and join them.

    Args:
        source: The drive.
        config: The configuration.
        options: Those of the run; ``workers`` says where pieces are mapped.
        run: The run.
        map_: Its map, which a drive that is resumed is in already.

    Raises:
        ReconError: As for `run_map`.
    """
    work, plan = Workspace(map_, run.watch, run.threads), run.state(_PLAN)
    spread = options.workers or BatchOptions(progress=options.progress)
    if len(map_.session()) and not plan.is_file():
        raise SettingsError("the run was begun in one piece", hint="resume it without --workers")
    _refuse_what_does_not_combine(config, options)
    if not len(map_.session()):
        limits, began = spread.share_cores(Limits(options.threads)), time.perf_counter()
        with run.stage("pieces"), connect(spread.scheduler, spread.workers_here) as cluster:
            pieces = _planned(plan, source, config, options, cluster)
            done = _work_off(pieces, plan, cluster, spread, limits)
        with run.stage("join"):
            join_pieces(map_, pieces, _opened(plan, len(pieces)), config)
        map_.session().set_state({"pieces": done, "seconds": time.perf_counter() - began})
        map_.commit()
        shutil.rmtree(_folder(plan), ignore_errors=True)
    return joined_drive(source, config, work)


def pieces_of(run: Run, map_: Map) -> dict[str, Any]:
    """Return what the record of a run has of its pieces; nothing if there were none."""
    state = map_.session().state() if begun_in_pieces(run) else None
    return {} if state is None else {"pieces": state["pieces"]}


def _refuse_what_does_not_combine(config: ReconConfig, options: MapOptions) -> None:
    """Refuse to cut a drive that cannot be cut.

    Raises:
        SettingsError: It cannot.
    """
    if options.known_poses is not None or options.prior is not None:
        what = "a drive with --poses or --prior is mapped in one piece"
        raise SettingsError(what, hint="drop --workers and --scheduler")
    if not config.occupancy.keep_rays:
        what = "pieces are joined by their rays"
        raise SettingsError(what, hint="drop occupancy.keep_rays=false")
    if not options.arguments.get("source"):
        what = "workers open the source by its path"
        raise SettingsError(what, hint="map a file or folder")


def _planned(
    plan: Path, source: StereoSource, config: ReconConfig, options: MapOptions, cluster: Cluster
) -> Sequence[Piece]:
    """Return the pieces of a drive that was begun, or those that the workers are to map."""
    begun = plan.is_file()
    pieces = read_plan(plan).pieces if begun else cut_drive(len(source), cluster.at_once)
    # Again for a run that is resumed, which may have another memory limit.
    write_plan(plan, PiecePlan(pieces, options.arguments, config.model_dump(mode="json")))
    return pieces


def _work_off(
    pieces: Sequence[Piece], plan: Path, cluster: Cluster, spread: BatchOptions, limits: Limits
) -> list[dict[str, Any]]:
    """Map pieces on workers; returns where, and what each took."""
    progress, results = spread.progress, {}
    jobs = [piece_job(plan, number, piece, limits) for number, piece in enumerate(pieces)]
    workers, dashboard = len(cluster.workers), cluster.dashboard
    spread.tell({"event": "cluster", "workers": workers, "dashboard": dashboard})
    progress.on_start("pieces", len(jobs), "pieces")
    try:
        for one, outcome in cluster.run(jobs, _folder(plan), spread.tell):
            if outcome.state != "succeeded":
                kind = RegistrationError if outcome.state == "failed" else ClusterError
                raise kind(f"frames {one.job.source} cannot be mapped", got=outcome.error)
            result = result_of(one.job, one.number + 1, outcome, _folder(plan))
            results[one.job.name] = result
            progress.on_step(JobStep(result, len(results), len(jobs)))
    finally:
        progress.on_finish()
    found = [results[job.name] for job in jobs]
    return [
        {
            **asdict(piece),
            "tries": one.tries,
            "worker": one.worker,
            "seconds": one.figures["seconds"],
            "peak_memory_mb": one.figures["peak_memory_mb"],
        }
        for piece, one in zip(pieces, found, strict=True)
    ]


def _opened(plan: Path, count: int) -> Iterator[Map]:
    """Open the maps of the pieces, one at a time."""
    for number in range(count):
        with closing(Map.open(_folder(plan) / str(number))) as map_:
            yield map_


def _folder(plan: Path) -> Path:
    """Return the folder that has the folders of the pieces."""
    return plan.resolve().with_suffix("")
