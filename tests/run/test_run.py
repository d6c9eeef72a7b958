"""A run's folder appears complete, or not at all, with configuration, summary and record."""

import itertools
import json
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from recon.core.errors import FormatError, OutputError
from recon.core.progress import Silent, showing
from recon.core.settings import Settings
from recon.core.summary import RunSummary, to_json
from recon.io.atomic import exchange
from recon.io.files import fingerprint
from recon.run import directory
from recon.run.directory import RunDirectory, state_folder
from recon.run.run import Run, WholeRun


class _Size(Settings):
    voxel_m: float = 0.1


@dataclass(frozen=True, kw_only=True)
class _Found(RunSummary):
    points: int


class _Notes(Silent):
    def __init__(self) -> None:
        self.stages: list[str] = []

    def on_stage(self, name: str) -> None:
        self.stages.append(name)


def test_a_run_writes_configuration_summary_and_record(tmp_path, monkeypatch):
    photo, out, peak_mb = tmp_path / "im0.png", tmp_path / "out", itertools.count(100.0)
    photo.write_bytes(b"pixels")
    monkeypatch.setattr("recon.run.run.peak_memory_mb", lambda: next(peak_mb))
    notes = _Notes()
    found = _Found(points=3, warnings=["few points"])
    with showing(notes), Run("pair", out, _Size(), threads=1) as run:
        for _ in range(2):
            with run.stage("match"):
                time.sleep(0.01)
        with run.report(found) as costed:
            assert yaml.safe_load(run.path("config.yaml").read_text()) == {"voxel_m": 0.1}
            shown = costed.to_json()
            run.path("report.html").write_text("<p>")
        with pytest.raises(ValueError, match="JSON"):
            run.write_json("figures.json", {"t_rel_percent": math.nan})
        done = run.finish(found, source="im0", inputs=[photo], record={"mapped_by": "demo"})
        summary = done.to_json()

    assert notes.stages == ["match", "match", "report", "hash"]
    assert json.loads((out / "summary.json").read_text()) == summary
    assert summary["out"] == str(out)
    cost = ("seconds", "stages", "peak_memory_mb")
    assert set(shown) == {"points", "warnings", *cost}
    assert shown == {**{key: summary[key] for key in cost}, "points": 3, "warnings": ["few points"]}
    assert list(shown["stages"]) == ["match"]
    assert 60 > shown["seconds"] >= shown["stages"]["match"] >= 0.02
    record = json.loads((out / "run.json").read_text())
    assert list(record["timings"]) == ["match", "report", "hash"]
    kept = ("command", "source", "inputs", "warnings", "mapped_by", "peak_memory_mb", "files")
    assert {name: record[name] for name in kept} == {
        "command": "pair",
        "source": "im0",
        "inputs": fingerprint([photo]),
        "warnings": ["few points"],
        "mapped_by": "demo",
        "peak_memory_mb": shown["peak_memory_mb"],
        "files": ["config.yaml", "report.html", "summary.json", "run.json"],
    }


def test_a_run_in_the_default_folder_gets_a_link_and_writes_no_configuration_that_there_is_not(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        with Run("map") as run:
            run.finish(RunSummary(), source="drive", inputs=[])
    runs = tmp_path / "outputs" / "map"
    stamps = sorted(path for path in runs.iterdir() if not path.is_symlink())
    assert len(stamps) == 2
    assert (runs / "latest").resolve() == stamps[-1]
    assert files_in(runs / "latest") == {"run.json", "summary.json"}


def test_a_hash_of_inputs_knows_their_names_bytes_and_order(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    one.write_bytes(b"a" * 3_000_000)
    other.write_bytes(b"b")
    found = fingerprint([one, other])
    assert (found["files"], found["bytes"]) == (2, 3_000_001)
    hashes = {found["sha256"], fingerprint([other, one])["sha256"]}
    one.write_bytes(b"a" * 2_999_999 + b"b")
    hashes.add(fingerprint([one, other])["sha256"])
    one.rename(tmp_path / "renamed")
    hashes.add(fingerprint([tmp_path / "renamed", other])["sha256"])
    assert len(hashes) == 4


def test_a_hash_of_samples_knows_small_files_and_what_changes_over_a_part_of_larger_ones(tmp_path):
    file, samples, length = tmp_path / "image.pgm", 32, 1_000_003

    def hashed(content: bytearray) -> str:
        file.write_bytes(content)
        return fingerprint([file], samples=samples)["sha256"]

    plain_image = hashed(bytearray(length))
    part = -(-length // (samples - 1))
    for start in (0, 4096, 500_000, length - part):
        content = bytearray(length)
        content[start : start + part] = b"x" * part
        assert hashed(content) != plain_image
    for length in (1, 4096, samples * 4096):  # small ones count to the last byte
        content = bytearray(length)
        before = hashed(content)
        content[-1] = 1
        assert hashed(content) != before
    assert hashed(bytearray()) != plain_image


@pytest.mark.parametrize("samples", [None, 32])
def test_a_pipe_is_not_hashed(tmp_path, samples):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FormatError, match=r"pipe: not a regular file \(got a named pipe\)"):
        fingerprint([tmp_path / "pipe"], samples=samples)


@dataclass(frozen=True)
class _Figures:
    error: float
    bad: dict[float, float]
    lengths: tuple[float, ...]


def write_run(folder: Path, *names: str, whole: bool = False) -> None:
    with WholeRun("merge", folder) if whole else RunDirectory(folder) as run:
        for name in names:
            run.path(name).write_text(name)
        run.write_json("run.json", {"files": [*run.files(), "run.json"]})


def fail_halfway(folder: Path, error: type[BaseException] = KeyError, begun: bool = False) -> None:
    def fail() -> None:
        with RunDirectory(folder) as run:
            run.state("map.recon").write_text("so far")
            run.begun = begun
            run.path("map/cloud.ply").write_text("half")
            assert ".partial" in {path.name for path in folder.iterdir()}
            raise error

    with pytest.raises(error):
        fail()


def files_in(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_a_failed_run_leaves_an_earlier_run_as_it_was_or_no_folder(tmp_path):
    fail_halfway(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    write_run(tmp_path / "run", "map/cloud.ply")
    fail_halfway(tmp_path / "run")
    assert (tmp_path / "run" / "map" / "cloud.ply").read_text() == "map/cloud.ply"
    assert files_in(tmp_path / "run") == {"map/cloud.ply", "run.json"}
    figures = _Figures(error=math.nan, bad={0.5: 1.25, 2.0: math.inf}, lengths=(50.0, 100.0))
    expected = {"error": None, "bad": {"0.5": 1.25, "2.0": None}, "lengths": [50.0, 100.0]}
    assert json.loads(json.dumps(to_json(figures), allow_nan=False)) == expected


@pytest.mark.parametrize(
    ("error", "begun", "stays"),
    [(OSError, True, True), (OSError, False, False), (KeyError, True, False)],
)
def test_what_the_input_did_not_cause_leaves_what_a_run_resumes_from(tmp_path, error, begun, stays):
    fail_halfway(tmp_path / "run", error, begun)
    assert (state_folder(tmp_path / "run") / "map.recon").is_file() == stays
    if stays:
        with RunDirectory(tmp_path / "run", resume=True) as run:
            assert (run.begun, run.files()) == (True, [])
            assert run.state("map.recon").read_text() == "so far"
    assert not state_folder(tmp_path / "run").exists()


@pytest.mark.parametrize(("exchanges", "left"), [(False, "old"), (True, "new")])
def test_a_run_that_is_interrupted_as_it_takes_the_place_of_another_leaves_one_of_them(
    tmp_path, monkeypatch, exchanges, left
):
    def interrupted(new: Path, old: Path) -> None:
        if exchanges:
            exchange(new, old)
        raise KeyboardInterrupt

    monkeypatch.setattr(directory, "exchange", interrupted)
    write_run(tmp_path / "run", "old")
    with pytest.raises(KeyboardInterrupt):
        write_run(tmp_path / "run", "new", whole=True)
    assert files_in(tmp_path) == {f"run/{left}", "run/run.json"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("resume", [False, True])
def test_an_address_is_not_taken_for_a_folder(tmp_path, monkeypatch, resume):
    monkeypatch.chdir(tmp_path)
    address = Path("s3://bucket/week")
    for out in (address, address.resolve()):
        with pytest.raises(OutputError, match="folder, not to an address"):
            RunDirectory(out, resume=resume).__enter__()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "s3:").mkdir()  # who has made it means it
    write_run(address, "summary.json")


@pytest.mark.parametrize("whole", [False, True])
def test_a_second_run_replaces_the_first_and_keeps_what_is_not_a_runs(tmp_path, whole):
    write_run(tmp_path / "run", "mesh/mesh.ply")
    (tmp_path / "run" / "notes.txt").write_text("mine")
    (tmp_path / "precious").write_text("stay")
    record = {"files": ["mesh/mesh.ply", "run.json", "../precious", str(tmp_path / "precious")]}
    (tmp_path / "run" / "run.json").write_text(json.dumps(record))
    killed = tmp_path / "run" / ".partial" / "map" / "octomap.ot"
    killed.parent.mkdir(parents=True)
    killed.write_text("half")
    write_run(tmp_path / "run", "map/cloud.ply", whole=whole)
    assert files_in(tmp_path / "run") == {"map/cloud.ply", "notes.txt", "run.json"}
    assert not (tmp_path / "run/mesh").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["precious", "run"]


@pytest.mark.parametrize(
    ("inside", "said"),
    [("", "are not of a run"), ("thesis", "is a file"), ("thesis/deeper", "cannot be written")],
)
def test_a_folder_of_other_files_and_a_file_are_refused(tmp_path, inside, said):
    (tmp_path / "thesis").write_text("years of work")
    with pytest.raises(OutputError, match=said) as told, RunDirectory(tmp_path / inside):
        pass
    assert str(tmp_path / inside) in str(told.value)
    assert "\n" not in str(told.value)
    assert files_in(tmp_path) == {"thesis"}


class TestMapInTheFolder:
    @staticmethod
    def made(out: Path, drives: int) -> bytes:
        """A finished run with a map of so many drives; the bytes of that."""
        (out / "map").mkdir(parents=True)
        (out / "map" / "map.recon").write_bytes(b"a year")
        (out / "summary.json").write_text(json.dumps({"sessions": [{}] * drives}))
        files = ["map/map.recon", "summary.json", "run.json"]
        (out / "run.json").write_text(json.dumps({"files": files}))
        return b"a year"

    @pytest.mark.parametrize(
        ("kind", "command", "drives"),
        [(WholeRun, "diff", 1), (Run, "batch", 3), (Run, "pair", 0), (Run, "map", 2)],
    )
    def test_it_is_not_lost_to_results_of_another_kind(self, tmp_path, kind, command, drives):
        year = self.made(tmp_path / "out", drives)
        one = "1 drive" if drives < 2 else f"{drives} drives"
        with pytest.raises(OutputError, match=f"replace a map .got one of {one}.*--into adds"):
            kind(command, tmp_path / "out").__enter__()
        assert (tmp_path / "out/map/map.recon").read_bytes() == year
        assert not (tmp_path / "out/.partial").exists()

    @pytest.mark.parametrize(
        ("kind", "command", "drives"),
        [(Run, "map", 1), (Run, "demo", 0), (WholeRun, "merge", 3), (WholeRun, "map", 3)],
    )
    def test_another_map_takes_its_place(self, tmp_path, kind, command, drives):
        self.made(tmp_path / "out", drives)
        with kind(command, tmp_path / "out") as run:
            run.finish(_Found(points=3), source="x", inputs=[])
        assert not (tmp_path / "out/map/map.recon").exists()
