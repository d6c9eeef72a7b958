"""One piece of a long drive, mapped by a worker into a folder of its own."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig
from recon.commands.map_options import MapRequest, begin_or_resume, identity_of
from recon.io.atomic import write_text
from recon.io.files import read_text, reading, resolved
from recon.map.drive.pieces import Piece
from recon.map.drive.sequence import map_sequence
from recon.map.drive.workspace import Workspace
from recon.map.sessions.copying import copy_sessions
from recon.map.store.map_file import MAP_FILE
from recon.map.verbs import Map
from recon.run.batch.job import Job
from recon.run.progress import SILENT, Progress
from recon.run.run import Run

_PLAN_BYTES: Final = 1 << 26


@dataclass(frozen=True)
class PiecePlan:
    """What the pieces are of, and where the drive is cut.

    Attributes:
        pieces: The pieces in order.
        arguments: The `MapRequest.arguments` of the run.
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
    source, _ = MapRequest.of(planned.arguments).open(config)
    part = planned.pieces[number].of(source)
    identity = identity_of(part, config, None)
    with (
        Run("piece", out, config, threads=threads, progress=progress, resume=resume) as run,
        begin_or_resume(run, part, config, identity, {}) as map_,
    ):
        work = Workspace(map_, run.watch, run.threads)
        map_sequence(part, config, progress=progress, workspace=work)
        with Map.create(run.path(MAP_FILE)) as kept:
            copy_sessions(map_, kept)
            kept.commit()
        summary = {"frames": len(part), "warnings": []}
        run.finish(summary, source=part.name, inputs=())
    return summary
