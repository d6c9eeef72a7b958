"""A run's folder appears complete, or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from recon.core.errors import OutputError
from recon.io.atomic import exchange
from recon.run import directory
from recon.run.directory import RunDirectory
from recon.run.run import Run, WholeRun


def write_run(folder: Path, *names: str, whole: bool = False) -> None:
    with WholeRun("merge", folder) if whole else RunDirectory(folder) as run:
        for name in names:
            run.path(name).write_text(name)
        run.write_json("run.json", {"files": [*run.files(), "run.json"]})


def fail_halfway(folder: Path) -> None:
    with RunDirectory(folder) as run:
        run.path("map/cloud.ply").write_text("half")
        raise KeyError


def files_in(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_files_appear_when_the_run_ends_well(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "map/cloud.ply", "summary.json")
    assert files_in(tmp_path / "run") == {"map/cloud.ply", "summary.json", "run.json"}


def test_nothing_is_there_while_the_run_goes_on(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run") as run:
        run.path("map/cloud.ply").write_text("half")
        assert not (tmp_path / "run" / "map").exists()


def test_a_failed_run_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(KeyError):
        fail_halfway(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_run_leaves_an_earlier_run_as_it_was(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "map/cloud.ply")
    with pytest.raises(KeyError):
        fail_halfway(tmp_path / "run")
    assert (tmp_path / "run" / "map" / "cloud.ply").read_text() == "map/cloud.ply"
    assert files_in(tmp_path / "run") == {"map/cloud.ply", "run.json"}


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


def test_a_second_run_replaces_the_first_and_keeps_what_is_not_a_runs(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "mesh/mesh.ply")
    (tmp_path / "run" / "notes.txt").write_text("mine")
    write_run(tmp_path / "run", "map/cloud.ply")
    assert files_in(tmp_path / "run") == {"map/cloud.ply", "notes.txt", "run.json"}


def test_what_a_killed_run_left_is_cleared(tmp_path: Path) -> None:
    leftover = tmp_path / "run" / ".partial" / "map" / "cloud.ply"
    leftover.parent.mkdir(parents=True)
    leftover.write_text("half")
    write_run(tmp_path / "run", "summary.json")
    assert files_in(tmp_path / "run") == {"summary.json", "run.json"}


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
