"""Workers for jobs: Dask on this machine, or a cluster that is there. Nothing else touches Dask."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final
from uuid import uuid4

from recon.core.errors import ClusterError, ReconError, SettingsError
from recon.core.optional import require
from recon.run.batch.job import Job, Outcome
from recon.run.batch.process import Tell, run_job

EXTRA: Final = "cluster"
_REACH_S: Final = 20.0
_WORKERS_S: Final = 120.0
_LOOK_S: Final = 30.0
_KEY: Final = "recon-job"
"""Dask keeps a list of the kinds of tasks, told by their keys, and looks through it at every step:
jobs are all of one kind."""


Work = Callable[[Job, str, bool, float], Outcome]
"""Runs a job in the folder of its batch, perhaps anew, and tells how far it is every so often."""


@dataclass(frozen=True)
class Try:
    """One try of a job.

    Attributes:
        job: The job.
        number: Its number, from 0.
        anew: Whether what an earlier try left is not used.
        only: Addresses of the workers that may run it; none = all.
    """

    job: Job
    number: int = 0
    anew: bool = False
    only: frozenset[str] = frozenset()


@dataclass(frozen=True)
class _Running:
    """A try that has not ended, and Dask's future of it."""

    one: Try
    future: Any


class Cluster:
    """Workers that run jobs; from `local_cluster` or `join_cluster`.

    Args:
        client: Dask's client of it.
        work: What a worker does for a job; None = what the job says.
        restart: Starts workers again that have died; None = others do that.
    """

    def __init__(
        self, client: Any, work: Work | None = None, restart: Callable[[], None] | None = None
    ) -> None:
        self._client, self._work, self._restart = client, work or _work, restart
        self._alive_s = time.monotonic()

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

    def run(
        self, jobs: Sequence[Job], folder: Path, tell: Tell = lambda event: None
    ) -> Iterator[tuple[Try, Outcome]]:
        """Run jobs, and yield how each ended.

        A job that broke (its worker died, it was killed or late) is tried again, and yielded when
        it succeeded or its retries are used up. Dask is given about two jobs for each that can run,
        and more whenever half of them have ended: what it does not know it need not keep in order.

        Args:
            jobs: The jobs.
            folder: Folder of the batch, seen by all workers.
            tell: Told how far each is, in another thread.

        Raises:
            ClusterError: The scheduler or all workers are gone.
        """
        every_s = max(1.0, len(self.workers) / 50)
        self._client.subscribe_topic(topic_of(folder), lambda event: tell(event[1]))
        ended, tries = SimpleQueue[Any](), dict[str, _Running]()
        waiting, room, late_s = deque(map(Try, jobs)), 0, 0.0
        while waiting or tries:
            if time.monotonic() > late_s:
                room, late_s = 2 * self._look() + 1, time.monotonic() + _LOOK_S
            if waiting and len(tries) <= room // 2:
                most = min(len(waiting), room - len(tries))
                some = [waiting.popleft() for _ in range(most)]
                for running in self._submit(some, folder, every_s):
                    tries[running.future.key] = running
                    running.future.add_done_callback(ended.put)
            for key, outcome in self._outcomes(ended, tries):
                done = tries.pop(key).one
                if outcome.state == "broken" and done.number < done.job.retries:
                    waiting.appendleft(self._again(done, outcome))
                else:
                    yield done, outcome
            for orphan in self._orphans(tries):
                tries.pop(orphan.future.key)
                orphan.future.cancel()
                waiting.appendleft(replace(orphan.one, only=frozenset()))

    def each(self, function: Callable[[Any], None], items: Sequence[Any]) -> None:
        """Run a function with each item on some worker, and wait until all is done.

        What it makes it leaves in files. One whose worker dies is called again on another, at most
        as often as Dask allows.

        Raises:
            ReconError: As the function.
            ClusterError: The scheduler or too many workers are gone.
        """
        futures = self._client.map(function, items, key=f"{function.__name__}-{uuid4().hex[:12]}")
        for future in require("distributed", extra=EXTRA).as_completed(futures):
            if future.status == "finished":
                continue
            error = future.exception() if future.status == "error" else None
            if isinstance(error, ReconError):
                raise error
            raise ClusterError("workers or their scheduler are gone", got=error or future.status)

    def _again(self, done: Try, outcome: Outcome) -> Try:
        """Return the next try of a job: on another worker, if the disk is full where it ran."""
        last = done.number + 1 == done.job.retries
        others = frozenset(self.workers) - {outcome.worker} if outcome.full else frozenset()
        return Try(done.job, done.number + 1, last and outcome.resumed, others)

    def _orphans(self, tries: Mapping[str, _Running]) -> list[_Running]:
        """Return tries of which all workers have died that may run them: Dask would wait."""
        tied = [running for running in tries.values() if running.one.only]
        alive = self.workers if tied else {}
        return [running for running in tied if not running.one.only & alive.keys()]

    def _outcomes(
        self, ended: SimpleQueue[Any], tries: Mapping[str, _Running]
    ) -> Iterator[tuple[str, Outcome]]:
        """Wait for futures that have ended; yield how, by key, of all that have by now."""
        futures = [self._next(ended)]
        while not ended.empty():
            futures.append(ended.get())
        futures = [one for one in futures if one is not None and one.key in tries]
        finished = {one.key: one for one in futures if one.status == "finished"}
        # At once, as each takes a round trip; that of none takes one as well.
        with _reaching():
            found = self._client.gather(finished, errors="skip") if finished else {}
        for one in futures:
            yield one.key, found[one.key] if one.key in found else _without_result(one)

    def _next(self, ended: SimpleQueue[Any]) -> Any:
        """Return the next future that has ended; None = none did for a while."""
        with suppress(Empty):
            return ended.get(timeout=_LOOK_S)
        return None

    def _look(self) -> int:
        """Return how many jobs run at once; workers of this machine that died are started again.

        Raises:
            ClusterError: All have died, and none comes back.
        """
        count, now_s = self.at_once, time.monotonic()
        self._alive_s = now_s if count else self._alive_s
        if self._restart is not None:
            if now_s > self._alive_s + _WORKERS_S:
                raise ClusterError("all workers of this machine have died")
            self._restart()
        return count

    def _submit(self, tries: Sequence[Try], folder: Path, every_s: float) -> Iterator[_Running]:
        """Give tries to Dask: all that may run at the same places in one message."""
        declared = self._declared() if any(one.job.needs for one in tries) else frozenset()
        alike: dict[Any, list[Try]] = {}
        for one in tries:
            needs = {name: least for name, least in one.job.needs.items() if name in declared}
            alike.setdefault((tuple(needs.items()), one.only), []).append(one)
        for (needs_of_all, only), some in alike.items():
            futures = self._client.map(
                self._work,
                [one.job for one in some],
                [str(folder)] * len(some),
                [one.anew for one in some],
                [every_s] * len(some),
                key=_KEY,
                pure=False,
                resources=dict(needs_of_all) or None,
                workers=list(only) or None,
            )
            yield from map(_Running, some, futures)

    def _declared(self) -> frozenset[str]:
        """Return the resources that all workers declare."""
        with _reaching():
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        names = [frozenset(worker["resources"]) for worker in workers.values()]
        return frozenset.intersection(*names) if names else frozenset()


@contextmanager
def local_cluster(workers: int) -> Iterator[Cluster]:
    """Start workers on this machine, each of which runs one job at a time.

    Raises:
        MissingDependencyError: Dask is not installed.
        ClusterError: The workers do not start.
    """
    distributed = require("distributed", extra=EXTRA)
    _be_quiet()
    require("dask", extra=EXTRA).config.set(
        {
            # A worker is not given a second job to wait behind its first.
            "distributed.scheduler.worker-saturation": 1.0,
            # Dask gives up one that it starts again and that is not there by then.
            "distributed.deploy.lost-worker-timeout": _WORKERS_S / 2,
        }
    )
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
        yield Cluster(client, restart=lambda: local.scale(workers))


@contextmanager
def join_cluster(address: str) -> Iterator[Cluster]:
    """Use the workers of a scheduler.

    Args:
        address: Its address, or the file that it was told to write it to.

    Raises:
        MissingDependencyError: Dask is not installed.
        SettingsError: The scheduler cannot be reached, or has no workers: nothing was begun.
    """
    distributed = require("distributed", extra=EXTRA)
    _be_quiet()
    try:
        where = {"scheduler_file" if Path(address).is_file() else "address": address}
        client = distributed.Client(**where, timeout=_REACH_S)
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError, ImportError) as error:
        # The last three: a protocol without its certificates, or without its library.
        raise SettingsError(
            "the scheduler cannot be reached", where=address, got=error, expected="tcp://host:8786"
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


def connect(scheduler: str | None, workers: int) -> AbstractContextManager[Cluster]:
    """Return the workers of a scheduler, or else new ones on this machine, for ``with``."""
    return local_cluster(workers) if scheduler is None else join_cluster(scheduler)


def topic_of(folder: Path | str) -> str:
    """Return the topic of Dask's events under which the jobs of a batch are told of."""
    return f"recon-jobs {folder}"


def _work(job: Job, folder: str, anew: bool, every_s: float) -> Outcome:
    """Run a job on a worker."""
    distributed = require("distributed", extra=EXTRA)
    worker = distributed.get_worker()
    key = distributed.worker.thread_state.key
    topic = topic_of(folder)
    tell: Callable[[dict[str, Any]], None] = lambda event: worker.log_event(topic, event)  # noqa: E731

    def stopped() -> bool:
        """Return whether the task was cancelled, or its client is gone."""
        task = worker.state.tasks.get(key)
        return task is None or task.state in ("cancelled", "released")

    tell({"event": "job", "name": job.name, "state": "running", "worker": worker.address})
    outcome = run_job(job, Path(folder), anew=anew, tell=tell, stopped=stopped, every_s=every_s)
    return Outcome(**{**vars(outcome), "worker": worker.address})


def _without_result(future: Any) -> Outcome:
    """Return how a try ended that gave nothing: its worker died with it."""
    if future.status != "error":
        raise ClusterError("the scheduler is gone", got=future.status)
    return Outcome("broken", f"its worker died ({type(future.exception()).__name__})")


@contextmanager
def _reaching() -> Iterator[None]:
    """Say in one line that the scheduler does not answer."""
    try:
        yield
    except (OSError, TimeoutError) as error:
        raise ClusterError("the scheduler is gone", got=error) from error


def _be_quiet() -> None:
    """Keep the messages of Dask from standard error: what matters of them is told by us."""
    # Dask gives each part of it a level of its own.
    parts = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    for name in (*parts, "distributed", "tornado", "bokeh", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    require("dask", extra=EXTRA).config.set({"logging.distributed": "critical"})
