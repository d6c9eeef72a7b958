"""Jobs on workers: what breaks is tried again, what fails is told, nothing is lost."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from recon.core.errors import (
    ClusterError,
    FormatError,
    MissingDependencyError,
    SettingsError,
)
from recon.run.batch.cluster import Cluster, Try, _Running, join_cluster, local_cluster
from recon.run.batch.job import Job, Outcome
from tests.run.batch.jobs import job, stand_in, tries

distributed = pytest.importorskip("distributed")
__all__ = ["stand_in"]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Two workers in threads of this process."""
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
        ) as local,
        distributed.Client(local) as client,
    ):
        yield Cluster(client)


def run(cluster: Cluster, jobs: list[Job], folder: Path) -> dict[str, tuple[Try, Outcome]]:
    ended = [(done.job.name, (done, outcome)) for done, outcome in cluster.run(jobs, folder)]
    assert sorted(name for name, _ in ended) == sorted(one.name for one in jobs)
    return dict(ended)


@pytest.mark.usefixtures("stand_in")
def test_a_poisoned_job_among_fifty_is_told_and_the_rest_goes_on(
    cluster: Cluster, tmp_path: Path
) -> None:
    jobs = [job(f"j{n}", "bad" if n == 17 else "good") for n in range(50)]
    ended = run(cluster, jobs, tmp_path)
    states = [outcome.state for _, outcome in ended.values()]
    assert (states.count("succeeded"), states.count("failed")) == (49, 1)
    assert ended["j17"][1].error == "nowhere: folder does not exist"
    assert all(tries(tmp_path, one.name) == ["begun"] for one in jobs)


@pytest.mark.usefixtures("stand_in")
def test_a_broken_job_goes_on_and_its_retries_have_a_limit(
    cluster: Cluster, tmp_path: Path
) -> None:
    jobs = [job("a", "killed once"), job("b", "always killed", retries=3), job("c", "full")]
    ended = run(cluster, jobs, tmp_path)
    assert ended["a"][1].state == "succeeded"
    assert tries(tmp_path, "a") == ["begun", "resumed"]
    assert (ended["b"][0].number, ended["b"][1].state) == (3, "broken")
    assert tries(tmp_path, "b") == ["begun"] * 4
    # The last try does without what the ones before have left, which may be damaged.
    assert tries(tmp_path, "c") == ["begun", "resumed", "begun"]


def test_a_job_that_finds_a_disk_full_is_tried_on_another_worker(
    cluster: Cluster, tmp_path: Path
) -> None:
    def full_at_first(job: Job, folder: str, anew: bool, every_s: float) -> Outcome:
        here, tried = distributed.get_worker().address, Path(folder) / job.name
        before = tried.read_text().split() if tried.is_file() else []
        tried.write_text(" ".join([*before, here]))
        if len(before) < 2:
            return Outcome("broken", worker=here, full=True)
        return Outcome("succeeded", worker=here)

    jobs = [job(f"j{n}") for n in range(6)]
    ended = run(Cluster(cluster._client, full_at_first), jobs, tmp_path)
    assert {outcome.state for _, outcome in ended.values()} == {"succeeded"}
    for one in jobs:
        first, second, third = (tmp_path / one.name).read_text().split()
        assert first != second != third


def test_dask_has_jobs_of_one_kind_and_about_two_for_each_that_can_run(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[int] = []
    submit = Cluster._submit
    monkeypatch.setattr(
        Cluster, "_submit", lambda *args: given.append(len(args[1])) or submit(*args)
    )
    quick = Cluster(cluster._client, lambda *job: Outcome("succeeded"))
    ended = run(quick, [job(f"j{n}") for n in range(40)], tmp_path)
    assert {outcome.state for _, outcome in ended.values()} == {"succeeded"}
    assert given[0] == 2 * quick.at_once + 1
    assert (sum(given), max(given)) == (40, given[0])
    kinds = cluster._client.run_on_scheduler(lambda dask_scheduler: [*dask_scheduler.task_prefixes])
    assert [kind for kind in kinds if "j1" in kind] == []


def test_workers_of_this_machine_that_died_are_started_again(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[str] = []
    local = Cluster(cluster._client, restart=lambda: begun.append("again"))
    assert local._look() == 2
    monkeypatch.setattr(Cluster, "workers", {})
    assert local._look() == 0
    assert begun == ["again"] * 2
    monkeypatch.setattr("recon.run.batch.cluster._WORKERS_S", -1.0)
    with pytest.raises(ClusterError, match="all workers of this machine have died"):
        local._look()


def test_a_try_whose_workers_have_all_died_is_not_waited_for(cluster: Cluster) -> None:
    alive, gone = next(iter(cluster.workers)), "tcp://192.0.2.1:9"
    tries = {
        name: _Running(Try(job(name), 1, only=frozenset(only)), None)
        for name, only in (("a", ()), ("b", (alive, gone)), ("c", (gone,)))
    }
    assert [running.one.job.name for running in cluster._orphans(tries)] == ["c"]


@pytest.mark.usefixtures("stand_in")
def test_two_batches_with_jobs_of_the_same_name_share_a_scheduler(
    cluster: Cluster, tmp_path: Path
) -> None:
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        told: list[Any] = []
        assert [o.state for _, o in cluster.run([job("a")], folder, told.append)] == ["succeeded"]
        assert (folder / "a" / "run.json").is_file()


@pytest.mark.usefixtures("stand_in")
def test_events_of_running_jobs_arrive(cluster: Cluster, tmp_path: Path) -> None:
    told: list[Any] = []
    list(cluster.run([job("a")], tmp_path, told.append))
    assert {"event": "job", "name": "a", "state": "running"}.items() <= told[0].items()


@pytest.mark.usefixtures("stand_in")
def test_needs_that_no_worker_declares_do_not_keep_a_job_waiting(
    cluster: Cluster, tmp_path: Path
) -> None:
    ended = run(cluster, [job("a", needs={"threads": 64.0})], tmp_path)
    assert ended["a"][1].state == "succeeded"


def test_a_function_is_called_with_each_item_and_its_error_is_raised(
    cluster: Cluster, tmp_path: Path
) -> None:
    def touch(name: str) -> None:
        if name == "bad":
            raise FormatError("damaged", where=name)
        (tmp_path / name).touch()

    cluster.each(touch, ["a", "b", "c"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]
    with pytest.raises(FormatError, match="bad: damaged"):
        cluster.each(touch, ["d", "bad"])


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recon.run.batch.cluster._REACH_S", 0.5)
    with pytest.raises(SettingsError, match="scheduler cannot be reached"):
        join_cluster("tcp://127.0.0.1:9").__enter__()


def test_a_scheduler_that_goes_while_it_is_asked_for_its_workers_is_one_line() -> None:
    class Gone:
        def nthreads(self) -> None:
            raise OSError("Timed out trying to connect to tcp://127.0.0.1:9 after 20 s")

    with pytest.raises(ClusterError, match="the scheduler is gone"):
        list(Cluster(Gone()).run([job("a")], Path()))


def test_without_dask_the_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    for there in (join_cluster("tcp://127.0.0.1:9"), local_cluster(1)):
        with pytest.raises(MissingDependencyError, match=r"pip install 'recon\[cluster\]'"):
            there.__enter__()
