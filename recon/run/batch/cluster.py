"""Workers for jobs: Dask on this machine, or a cluster that is there. Nothing else touches Dask."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from recon.core.errors import ClusterError, ReconError, SettingsError, require
from recon.core.machine import available_cores
from recon.run.batch.job import Job, Outcome, last_outcome, run_job

EXTRA: Final = "cluster"
_REACH_S: Final = 20.0
_WORKERS_S: Final = 120.0
_AT_ONCE: Final = 10_000
"""Jobs that Dask has at a time: more than any cluster runs, few enough to begin at once."""
_KEY: Final = "recon-job"
"""Dask keeps a list of the kinds of tasks, told by their keys, and looks through it at every step:
jobs are all of one kind."""
_LOCAL: Final[dict[str, Any]] = {
    # A worker is not given a second job to wait behind its first.
    "distributed.scheduler.worker-saturation": 1.0,
    # Workers that die are started again, however long that takes.
    "distributed.deploy.lost-worker-timeout": "1 day",
    "distributed.scheduler.no-workers-timeout": _WORKERS_S,
    # Not every site that a browser of this machine shows may read the dashboard.
    "distributed.scheduler.dashboard.bokeh-application.allow_websocket_origin": [
        "127.0.0.1", "localhost",
    ],
}  # fmt: skip

#: An address or file that is none; a protocol without certificates or library; a mad answer.
_NO_SCHEDULER: Final = (
    ValueError, TypeError, KeyError, RuntimeError, ImportError, MemoryError,
)  # fmt: skip
Work = Callable[[Job, str], Outcome]  # runs a job in the folder of its batch


@dataclass(frozen=True)
class BatchOptions:
    """How jobs are run, until the first one fails or all are done.

    Into a folder (None = a new one below ``outputs/``), by Dask's scheduler of this address (None =
    workers on this machine, one per core unless their number is given).
    """

    out: Path | None = None
    scheduler: str | None = None
    workers: int | None = None
    fail_fast: bool = False

    def connect(self) -> AbstractContextManager[Cluster]:
        if self.scheduler is not None:
            return join_cluster(self.scheduler)
        return local_cluster(self.workers or available_cores())

    def threads_of(self, threads: int | None) -> int | None:
        """Return the threads of a job, by default a fraction of the cores of this machine."""
        if threads is not None or self.scheduler is not None:
            return threads
        return max(1, available_cores() // (self.workers or available_cores()))


class Cluster:
    """Workers that run jobs, by a client of Dask; from `local_cluster` or `join_cluster`."""

    def __init__(self, client: Any, work: Work | None = None) -> None:
        self._client, self._work = client, work or _work

    @property
    def dashboard(self) -> str:
        """Address of Dask's page that shows what the workers do."""
        return str(self._client.dashboard_link)

    @property
    def workers(self) -> dict[str, int]:
        """How many jobs each worker runs at once, by its address."""
        with _reaching():
            return dict(self._client.nthreads())

    @property
    def at_once(self) -> int:
        """How many jobs run at once, as far as workers are known now."""
        return sum(self.workers.values())

    def run(self, jobs: Iterable[Job], folder: Path) -> Iterator[tuple[Job, Outcome]]:
        """Run jobs into a folder that all workers see, and yield how each ended.

        One that broke (its workers died, it was killed or late) is tried again, up to its retries.
        """
        dask, waiting = require("distributed", extra=EXTRA), iter(jobs)
        ended = dask.as_completed(with_results=True, raise_errors=False)
        tries: dict[str, tuple[Job, int]] = {}

        def give(some: Iterable[Job], number: int = 0, workers: Sequence[str] = ()) -> None:
            for job, future in self._submit(list(some), str(folder), workers):
                tries[future.key] = job, number
                ended.add(future)

        give(islice(waiting, _AT_ONCE))
        for future, result in ended:
            job, number = tries.pop(future.key)
            outcome = _outcome(future, result, job, folder)
            if outcome.state == "broken" and number < job.retries:
                others = {*self.workers} - {outcome.worker} if outcome.full else ()
                give([job], number + 1, [*others])
            else:  # the log of a worker with a disk of its own lacks the tries of others
                yield job, replace(outcome, tries=max(outcome.tries, number + 1))
            if len(tries) < _AT_ONCE // 2:
                give(islice(waiting, _AT_ONCE // 2))

    def each(self, function: Callable[[Any], None], items: Sequence[Any]) -> None:
        """Run a function with each item on a worker, again if that dies, and wait for all."""
        futures = self._client.map(function, items, key=uuid4().hex)
        for future in require("distributed", extra=EXTRA).as_completed(futures):
            if future.status == "finished":
                continue
            error = future.exception() if future.status == "error" else None
            if isinstance(error, ReconError):
                raise error
            raise ClusterError("workers or their scheduler are gone", got=error or future.status)

    def _submit(
        self, jobs: list[Job], folder: str, workers: Sequence[str]
    ) -> Iterator[tuple[Job, Any]]:
        """Give jobs to Dask, all with the same needs in one message."""
        declared: frozenset[str] = frozenset()  # what all workers do
        if any(job.needs for job in jobs):
            with _reaching():
                workers_now = self._client.scheduler_info(n_workers=-1)["workers"].values()
            names = [frozenset(worker["resources"]) for worker in workers_now]
            declared = frozenset.intersection(*names) if names else declared
        groups: dict[tuple[tuple[str, float], ...], list[Job]] = {}
        for job in jobs:
            needs = tuple((name, job.needs[name]) for name in declared if name in job.needs)
            groups.setdefault(needs, []).append(job)
        for needs, alike in groups.items():
            futures = self._client.map(
                self._work,
                alike,
                folder=folder,
                key=_KEY,
                pure=False,
                resources=dict(needs) or None,
                workers=workers or None,
                allow_other_workers=bool(workers),  # where these die, too
            )
            yield from zip(alike, futures, strict=True)


@contextmanager
def local_cluster(workers: int) -> Iterator[Cluster]:
    """Start workers on this machine, each of which runs one job at a time."""
    distributed = _quiet_dask(_LOCAL)
    try:
        local = distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=0,  # the jobs are processes of their own
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:
        raise ClusterError("the workers of this machine do not start", got=error) from error
    with local, distributed.Client(local) as client:
        yield Cluster(client)


@contextmanager
def join_cluster(address: str) -> Iterator[Cluster]:
    """Use the workers of a scheduler, by its address or the file that it writes this to."""
    distributed = _quiet_dask({})
    try:
        file = Path(address)
        where = json.loads(file.read_text())["address"] if file.is_file() else address
        # Dask waits without end for the greeting of what is no scheduler.
        distributed.utils.LoopRunner().run_sync(_greet, where)
        client = distributed.Client(where, timeout=_REACH_S)
    except (OSError, asyncio.TimeoutError, *_NO_SCHEDULER) as error:
        got = str(error) or f"no scheduler of Dask that answers within {_REACH_S:g} s"
        raise SettingsError(
            "the scheduler cannot be reached", where=address, got=got, expected="tcp://host:8786"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError as error:
            raise SettingsError(
                "the scheduler has no workers",
                where=address,
                hint="start some: dask worker ADDRESS",
            ) from error
        yield Cluster(client)


async def _greet(address: str) -> None:
    """Exchange greetings with a scheduler."""
    distributed = require("distributed", extra=EXTRA)
    keys = distributed.Security().get_connection_args("client")
    connecting = distributed.comm.connect(address, timeout=_REACH_S, **keys)
    comm = await asyncio.wait_for(connecting, _REACH_S)
    await comm.close()


def _work(job: Job, folder: str) -> Outcome:
    distributed = require("distributed", extra=EXTRA)
    worker, key = distributed.get_worker(), distributed.worker.thread_state.key

    def stopped() -> bool:  # the task was cancelled, or its client is gone
        task = worker.state.tasks.get(key)
        return task is None or task.state in ("cancelled", "released")

    return run_job(job, Path(folder), worker.address, stopped)


def _outcome(future: Any, result: Any, job: Job, folder: Path) -> Outcome:
    if future.status == "finished":
        return result  # type: ignore[no-any-return]
    if future.status != "error":
        raise ClusterError("the scheduler is gone", got=future.status)
    error, kind = future.exception(), type(future.exception()).__name__
    if kind == "NoWorkerError":
        raise ClusterError("all workers have died", got=error)
    why = "its worker died" if kind == "KilledWorker" else f"{kind}: {error}"
    return replace(last_outcome(folder, job.name), state="broken", error=why)


@contextmanager
def _reaching() -> Iterator[None]:
    """Say in one line that the scheduler does not answer."""
    try:
        yield
    except (OSError, TimeoutError) as error:
        raise ClusterError("the scheduler is gone", got=error) from error


def _quiet_dask(settings: dict[str, Any]) -> Any:
    """Return Dask, whose messages do not reach standard error: what matters of them we say."""
    distributed = require("distributed", extra=EXTRA)
    # Dask gives each part of it a level of its own.
    parts = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    for name in (*parts, "distributed", "tornado", "bokeh", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    require("dask", extra=EXTRA).config.set({"logging.distributed": "critical", **settings})
    return distributed
