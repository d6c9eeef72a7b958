"""`recon map --workers`: a long drive in pieces, each mapped by a process of its own somewhere."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig
from recon.commands.map_options import MapOptions
from recon.core.errors import ClusterError, RegistrationError, SettingsError
from recon.io.atomic import write_text
from recon.io.files import read_text, reading, resolved
from recon.map.drive.pieces import Piece, cut_drive, join_pieces, joined_drive
from recon.map.drive.sequence import MappedSequence, map_sequence
from recon.map.drive.workspace import Workspace
from recon.map.sessions.copying import copy_sessions
from recon.map.store.map_file import MAP_FILE
from recon.map.verbs import Map
from recon.run.batch.cluster import BatchOptions, Cluster
from recon.run.batch.job import Job
from recon.run.batch.results import JobResult, work_off
from recon.run.progress import SILENT, Progress
from recon.run.run import Run
from recon.sources.source import StereoSource

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
    """
    work, plan = Workspace(map_, run.watch, run.threads), run.state(_PLAN)
    spread = options.workers or BatchOptions(progress=options.progress)
    if len(map_.session()) and not plan.is_file():
        raise SettingsError("the run was begun in one piece", hint="resume it without --workers")
    _refuse_what_does_not_combine(config, options)
    if not len(map_.session()):
        threads, began = spread.threads_of(options.threads), time.perf_counter()
        with run.stage("pieces"), spread.connect() as cluster:
            pieces = _planned(plan, source, config, options, cluster)
            jobs = [piece_job(plan, n, piece, threads) for n, piece in enumerate(pieces)]
            results = work_off(jobs, _folder(plan), cluster, spread, "pieces")
            found = {one.job.name: _checked(one) for one in results}
            done = [asdict(piece) | found[str(n)] for n, piece in enumerate(pieces)]
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
    """Refuse to cut a drive that cannot be cut."""
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


def _checked(one: JobResult) -> dict[str, Any]:
    """Return where a piece was mapped, and what it took."""
    if not one.ok:
        kind = RegistrationError if one.last.state == "failed" else ClusterError
        raise kind(f"frames {one.job.source} cannot be mapped", got=one.last.error)
    taken = {name: one.figures[name] for name in ("seconds", "peak_memory_mb")}
    return {"tries": one.last.tries, "worker": one.last.worker, **taken}


def _opened(plan: Path, count: int) -> Iterator[Map]:
    """Open the maps of the pieces, one at a time."""
    for number in range(count):
        with closing(Map.open(_folder(plan) / str(number))) as map_:
            yield map_


def _folder(plan: Path) -> Path:
    """Return the folder that has the folders of the pieces."""
    return resolved(plan).with_suffix("")


_PLAN_BYTES: Final = 1 << 26


@dataclass(frozen=True)
class PiecePlan:
    """What the pieces are of, and where the drive is cut.

    Attributes:
        pieces: The pieces in order.
        arguments: The `MapOptions.arguments` of the run.
        config: Its configuration, as plain values.
    """

    pieces: Sequence[Piece]
    arguments: Mapping[str, Any]
    config: Mapping[str, Any]


def write_plan(path: Path, plan: PiecePlan) -> None:
    """Write a plan as JSON."""
    write_text(path, json.dumps(asdict(plan), indent=1))


def read_plan(path: Path) -> PiecePlan:
    """Read a plan."""
    with reading(path):
        content = json.loads(read_text(path, _PLAN_BYTES))
        pieces = [Piece(**piece) for piece in content["pieces"]]
        return PiecePlan(pieces, content["arguments"], content["config"])


def piece_job(plan: Path, number: int, piece: Piece, threads: int | None) -> Job:
    """Return what a worker does for a piece: it runs `run_piece`."""
    limit = () if threads is None else ("--threads", str(threads))
    return Job(
        name=str(number),
        command="piece",
        source=f"{piece.first} to {piece.last - 1}",
        words=("piece", str(resolved(plan)), str(number), *limit, "--json", "--verbose"),
        writes=True,
        folder=str(Path.cwd()),
    )


def run_piece(
    plan: Path,
    number: int,
    out: Path,
    *,
    resume: bool = False,
    threads: int | None = None,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Map a piece of a drive into a folder.

    Args:
        plan: What the pieces are of.
        number: Number of the piece.
        out: Its folder, which gets its map.
        resume: Go on with what is in the folder.
        threads: Threads to use; None = all cores. Changes no result.
        progress: Shown each frame.

    Returns:
        The figures of ``summary.json``.
    """
    planned = read_plan(plan)
    config = ReconConfig.parse(planned.config, where=str(plan))
    # Loops are looked for in the whole drive.
    loops = config.loops.model_copy(update={"enabled": False})
    config = config.model_copy(update={"loops": loops})
    source, _ = MapOptions.of(planned.arguments).open(config)
    part = planned.pieces[number].of(source)
    options = MapOptions("piece", out, threads, progress=progress, resume=resume)
    with (
        options.run(config) as run,
        options.begin(run, part, config) as map_,
    ):
        work = Workspace(map_, run.watch, run.threads)
        map_sequence(part, config, progress=progress, workspace=work)
        with Map.create(run.path(MAP_FILE)) as kept:
            copy_sessions(map_, kept)
            kept.commit()
        summary = {"frames": len(part), "warnings": []}
        run.finish(summary, source=part.name, inputs=())
    return summary
