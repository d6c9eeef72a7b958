"""Jobs on workers: what breaks is tried again, what fails is named, nothing is lost."""

import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import ClassVar

import pytest

from recon.core.errors import ClusterError, FormatError, MissingDependencyError, SettingsError
from recon.run.batch.cluster import BatchOptions, Cluster, join_cluster, local_cluster
from recon.run.batch.job import Job, Outcome
from recon.run.batch.results import work_off
from tests.run.batch.jobs import job, tries

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
        ) as local,
        distributed.Client(local) as client,
    ):
        yield Cluster(client)


def run(cluster: Cluster, jobs: list[Job], folder: Path) -> dict[str, Outcome]:
    ended = [(done.name, outcome) for done, outcome in cluster.run(jobs, folder)]
    assert sorted(name for name, _ in ended) == sorted(one.name for one in jobs)
    return dict(ended)


def test_what_breaks_goes_on_and_what_fails_is_named_and_the_rest_is_done(cluster, tmp_path):
    good = [job(f"j{n}") for n in range(25)]
    jobs = [job("a", "killed once"), job("b", "always killed", retries=3), job("c", "damaged")]
    ended = run(cluster, [*good[:9], *jobs, job("d", "bad"), *good[9:]], tmp_path)
    assert {ended[one.name].state for one in good} == {"succeeded"}
    assert all(tries(tmp_path, one.name) == ["begun"] for one in good)
    assert (ended["a"].state, ended["a"].tries) == ("succeeded", 2)
    assert tries(tmp_path, "a") == ["begun", "resumed"]
    assert (ended["b"].state, ended["b"].tries) == ("broken", 4)
    assert tries(tmp_path, "b") == ["begun"] * 4
    # The last try does without what the ones before have left.
    assert tries(tmp_path, "c") == ["begun", "resumed", "begun"]
    assert (ended["d"].state, ended["d"].tries) == ("failed", 1)
    assert ended["d"].error == "nowhere: folder does not exist"
    ended = run(cluster, [job("a", retries=1)], tmp_path / "unseen")
    assert (ended["a"].state, "unseen" in ended["a"].error) == ("broken", True)


def test_a_job_that_finds_a_disk_full_is_tried_on_another_worker(cluster, tmp_path):
    def full_at_first(job: Job, folder: str) -> Outcome:
        here, tried = distributed.get_worker().address, Path(folder) / job.name
        before = tried.read_text().split() if tried.is_file() else []
        tried.write_text(" ".join([*before, here]))
        if len(before) < 2:
            return Outcome("broken", worker=here, full=True)
        return Outcome("succeeded", worker=here)

    jobs = [job(f"j{n}") for n in range(6)]
    ended = run(Cluster(cluster._client, full_at_first), jobs, tmp_path)
    assert {outcome.state for outcome in ended.values()} == {"succeeded"}
    for one in jobs:
        first, second, third = (tmp_path / one.name).read_text().split()
        assert first != second != third


def test_dask_has_jobs_of_one_kind_and_not_all_of_very_many(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr("recon.run.batch.cluster._AT_ONCE", 10)
    taken: list[str] = []

    def many() -> Iterator[Job]:
        for number in range(40):
            taken.append(f"j{number}")
            yield job(taken[-1])

    quick = Cluster(cluster._client, lambda job, folder: Outcome("succeeded"))
    ended = [len(taken) - number for number, _ in enumerate(quick.run(many(), tmp_path))]
    assert (len(ended), len(taken)) == (40, 40)
    assert max(ended) <= 10
    kinds = cluster._client.run_on_scheduler(lambda dask_scheduler: [*dask_scheduler.task_prefixes])
    assert [kind for kind in kinds if "j1" in kind] == []


def test_jobs_need_of_workers_what_all_of_these_declare():
    class Client:
        asked: ClassVar[dict[str, object]] = {}

        def scheduler_info(self, n_workers: int) -> dict[str, dict[str, object]]:
            assert n_workers == -1  # all of them, not only the first
            return {"workers": {"a": {"resources": {"threads": 8, "memory": 1e9}},
                                "b": {"resources": {"threads": 4}}}}  # fmt: skip

        def map(self, work: object, jobs: list[Job], resources: object, **_: object) -> list[str]:
            self.asked |= {one.name: resources for one in jobs}
            return [one.name for one in jobs]

    needs: list[dict[str, float]] = [{"threads": 2, "memory": 5e8}, {}, {"memory": 5e8}]
    jobs = [job(f"j{n}", needs=each) for n, each in enumerate(needs)]
    found = list(Cluster(Client())._submit(jobs, "", ()))
    assert sorted(found, key=str) == [(one, one.name) for one in jobs]
    assert Client.asked == {"j0": {"threads": 2}, "j1": None, "j2": None}


def test_workers_that_do_not_come_back_end_the_batch(cluster, tmp_path):
    def nobody(job: Job, folder: str) -> Outcome:
        raise distributed.scheduler.NoWorkerError(job.name, 120)

    with pytest.raises(ClusterError, match="all workers have died"):
        run(Cluster(cluster._client, nobody), [job("a")], tmp_path)


def test_two_batches_with_jobs_of_the_same_name_share_a_scheduler(cluster, tmp_path):
    for folder in (tmp_path / "0", tmp_path / "state" / "1"):  # which is made for its workers
        (result,) = work_off([job("a")], folder, cluster, BatchOptions())
        assert (result.ok, result.figures["points"]) == (True, 7)
        assert (folder / "a" / "run.json").is_file()


def test_a_function_is_called_with_each_item_and_its_error_is_raised(cluster, tmp_path):
    def touch(name: str) -> None:
        if name == "bad":
            raise FormatError("damaged", where=name)
        (tmp_path / name).touch()

    cluster.each(touch, ["a", "b", "c"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]
    with pytest.raises(FormatError, match="bad: damaged"):
        cluster.each(touch, ["d", "bad"])
    with pytest.raises(ClusterError, match="no number"):
        cluster.each(int, ["no number"])


def test_workers_share_the_cores_of_this_machine(monkeypatch):
    monkeypatch.setattr("recon.run.batch.cluster.available_cores", lambda: 8)
    ratios = [BatchOptions(workers=count).threads_of(None) for count in (None, 1, 3, 9)]
    assert ratios == [1, 8, 2, 1]
    assert BatchOptions(workers=3).threads_of(5) == 5
    assert BatchOptions(scheduler="tcp://x:1").threads_of(None) is None


def assert_not_reached(address: str | Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("recon.run.batch.cluster._REACH_S", 1.0)
        with pytest.raises(SettingsError, match="scheduler cannot be reached") as caught:
            join_cluster(str(address)).__enter__()
    assert caught.value.where == str(address)
    assert caught.value.got


@pytest.mark.parametrize(
    ("protocol", "greeting"),
    [
        ("tcp://", b""),
        ("tcp://", b"HTTP/1.1 400 Bad Request\r\n\r\n" + bytes(1000)),
        ("tls://", b"SSH-2.0-OpenSSH_9.6\r\n"),
        ("", b"SSH-2.0-OpenSSH_9.6\r\n"),
    ],
)
def test_what_is_no_scheduler_is_one_line_and_not_waited_for(protocol, greeting):
    kept: list[socket.socket] = []

    def serve() -> None:
        with suppress(OSError):
            while True:
                kept.append(listening.accept()[0])
                kept[-1].sendall(greeting)

    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve, daemon=True).start()
        assert_not_reached(f"{protocol}127.0.0.1:{listening.getsockname()[1]}")
    for connection in kept:
        connection.close()


def test_a_scheduler_that_goes_and_dask_that_is_not_there_are_one_line(monkeypatch):
    class Gone:
        def nthreads(self) -> None:
            raise OSError("Timed out trying to connect to tcp://127.0.0.1:9 after 20 s")

    with pytest.raises(ClusterError, match="the scheduler is gone"):
        Cluster(Gone()).workers  # noqa: B018
    monkeypatch.setitem(sys.modules, "distributed", None)
    for there in (join_cluster("tcp://127.0.0.1:9"), local_cluster(1)):
        with pytest.raises(MissingDependencyError, match=r"pip install 'recon-stereo\[cluster\]'"):
            there.__enter__()


def test_the_dashboard_of_this_machine_is_not_for_other_sites():
    client = pytest.importorskip("websockets.sync.client")
    refused = pytest.importorskip("websockets.exceptions").InvalidStatus
    token = pytest.importorskip("bokeh.util.token")
    with local_cluster(1) as one:
        page = one.dashboard.rpartition("/")[0]
        there = page.replace("http", "ws", 1) + "/individual-progress/ws"

        def join(origin: str) -> AbstractContextManager[object]:
            words = ["bokeh", token.generate_jwt_token(token.generate_session_id())]
            return client.connect(there, origin=origin, subprotocols=words)

        with join(page):
            pass
        for origin in ("http://elsewhere.example", page.replace("127.0.0.1", "127.0.0.1.example")):
            with pytest.raises(refused, match="403"), join(origin):
                pass
