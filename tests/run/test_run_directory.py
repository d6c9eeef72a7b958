"""A run's folder appears complete, or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from recon.core.errors import FormatError, OutputError
from recon.io.atomic import exchange
from recon.run import directory
from recon.run.directory import RunDirectory, refuse_links, state_folder
from recon.run.run import Run, WholeRun


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
            raise error

    with pytest.raises(error):
        fail()


def files_in(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_files_appear_when_the_run_ends_well(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run") as run:
        run.path("map/cloud.ply").write_text("half")
        assert [path.name for path in (tmp_path / "run").iterdir()] == [".partial"]
    assert files_in(tmp_path / "run") == {"map/cloud.ply"}


def test_a_failed_run_leaves_an_earlier_run_as_it_was_or_no_folder(tmp_path: Path) -> None:
    fail_halfway(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    write_run(tmp_path / "run", "map/cloud.ply")
    fail_halfway(tmp_path / "run")
    assert (tmp_path / "run" / "map" / "cloud.ply").read_text() == "map/cloud.ply"
    assert files_in(tmp_path / "run") == {"map/cloud.ply", "run.json"}


@pytest.mark.parametrize(
    ("error", "begun", "stays"),
    [(OSError, True, True), (OSError, False, False), (KeyError, True, False)],
)
def test_what_the_input_did_not_cause_leaves_what_a_run_resumes_from(
    tmp_path: Path, error: type[BaseException], begun: bool, stays: bool
) -> None:
    fail_halfway(tmp_path / "run", error, begun)
    assert (state_folder(tmp_path / "run") / "map.recon").is_file() == stays
    if stays:
        with RunDirectory(tmp_path / "run", resume=True) as run:
            assert (run.begun, run.files()) == (True, [])
            assert run.state("map.recon").read_text() == "so far"
    assert not state_folder(tmp_path / "run").exists()


@pytest.mark.parametrize(("exchanges", "left"), [(False, "old"), (True, "new")])
def test_a_run_that_is_interrupted_as_it_takes_the_place_of_another_leaves_one_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanges: bool, left: str
) -> None:
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
def test_an_address_is_not_taken_for_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resume: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    address = Path("s3://bucket/week")
    for out in (address, address.resolve()):
        with pytest.raises(OutputError, match="folder, not to an address"):
            RunDirectory(out, resume=resume).__enter__()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "s3:").mkdir()  # who has made it means it
    write_run(address, "summary.json")


@pytest.mark.parametrize("whole", [False, True])
def test_a_second_run_replaces_the_first_and_keeps_what_is_not_a_runs(
    tmp_path: Path, whole: bool
) -> None:
    write_run(tmp_path / "run", "mesh/mesh.ply")
    (tmp_path / "run" / "notes.txt").write_text("mine")
    killed = tmp_path / "run" / ".partial" / "map" / "octomap.ot"
    killed.parent.mkdir(parents=True)
    killed.write_text("half")
    write_run(tmp_path / "run", "map/cloud.ply", whole=whole)
    assert files_in(tmp_path / "run") == {"map/cloud.ply", "notes.txt", "run.json"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_folder_of_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match="not of a run"), RunDirectory(tmp_path):
        pass
    assert files_in(tmp_path) == {"thesis.tex"}


@pytest.mark.parametrize("inside", ["", "deeper"])
def test_an_unwritable_folder_is_one_clear_line(tmp_path: Path, inside: str) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputError) as caught, RunDirectory(tmp_path / "file" / inside):
        pass
    assert str(tmp_path / "file") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_record_that_names_files_outside_deletes_nothing(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "summary.json")
    (tmp_path / "precious").write_text("stay")
    record = {"files": ["../precious", str(tmp_path / "precious")]}
    (tmp_path / "run" / "run.json").write_text(json.dumps(record))
    write_run(tmp_path / "run", "summary.json")
    assert (tmp_path / "precious").read_text() == "stay"


def test_links_below_a_folder_are_refused_and_the_folder_may_be_one(tmp_path: Path) -> None:
    (tmp_path / "run" / "map").mkdir(parents=True)
    (tmp_path / "latest").symlink_to("run")
    refuse_links(tmp_path / "latest" / "map")
    with pytest.raises(FormatError, match="latest"):
        refuse_links(tmp_path / "latest" / "map", below=tmp_path)
    (tmp_path / "run" / "map" / "cloud.ply").symlink_to("/etc/passwd")
    with pytest.raises(FormatError, match=r"cloud\.ply"):
        refuse_links(tmp_path / "run")


def test_nan_is_refused_in_json(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"), RunDirectory(tmp_path / "run") as run:
        run.write_json("summary.json", {"t_rel_percent": float("nan")})


def test_default_folder_gets_a_link_to_the_latest_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        with Run("map") as run:
            run.write_json("run.json", {"files": []})
    stamps = sorted(p for p in (tmp_path / "outputs" / "map").iterdir() if not p.is_symlink())
    assert len(stamps) == 2
    assert (tmp_path / "outputs" / "map" / "latest").resolve() == stamps[-1]
