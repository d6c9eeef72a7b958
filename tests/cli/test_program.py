"""Command lines of jobs are those of the program, and stay in their folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from recon.cli.program import _NOT_OPTIONS, COMMANDS, _command, plan_jobs
from recon.cli.tables import (
    print_batch,
    print_figures,
    print_remarks,
    print_rows,
)
from recon.commands.batch import BatchSummary
from recon.commands.map_pieces import Piece, piece_job
from recon.core.errors import SettingsError
from recon.run.batch.job import Job
from recon.run.batch.job_file import JobList
from recon.run.batch.results import JobFacts, JobSummary
from tests.docs.blocks import ROOT

DRIVE = {"name": "a", "command": "map", "source": ["drive"]}


def plan(*jobs: Mapping[str, Any], folder: Path = ROOT, **sweep: Sequence[Any]) -> list[Job]:
    names = {key.replace("__", "."): values for key, values in sweep.items()}
    return plan_jobs(
        JobList.model_validate({"job": [*jobs], "sweep": names, "folder": str(folder)})
    )


def line(folder: Path = ROOT, /, **changes: Any) -> list[str]:
    (job,) = plan({**DRIVE, **changes}, folder=folder)
    return job.command_line(Path("out"))


def test_a_command_line_has_what_the_job_says_and_limits_are_needs_of_a_worker():
    changes = {"options": ["--no-mesh"], "set": ["matching.window_px=9"]}
    limits = {"threads": 2, "memory": "4G", "timeout_s": 5.0, "retries": 0}
    (job,) = plan({**DRIVE, **changes, **limits})
    assert job.command_line(Path("out")) == [
        "map", "drive", "--set", "matching.window_px=9", "--threads", "2", "--memory-limit",
        "4G", "--no-mesh", "--json", "--verbose", "--out", "out",
    ]  # fmt: skip
    assert (job.timeout_s, job.retries, job.needs) == (5.0, 0, {"threads": 2.0, "memory": 4e9})
    sources = ["a.txt", "b.txt"]  # of a command that has no such limits
    words = line(command="evaluate trajectory", source=sources, threads=1, memory="2G")
    assert words == ["evaluate", "trajectory", *sources, "--json", "--verbose", "--out", "out"]


SOURCES = {
    "merge": 2, "diff": 2, "pair": 2, "disparity": 2, "rectify": 2, "demo": 0,
    "evaluate trajectory": 2, "evaluate map": 2, "evaluate disparity": 2,
}  # fmt: skip

INPUTS = {
    "--poses", "--calib", "--config", "--map", "--georeference", "--truth", "--align-to", "--mask",
    "--confidence", "--images", "--results", "--times",
}  # fmt: skip
"""Options that name files which are read."""


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_line_of_a_job_is_one_of_the_program_and_names_no_other_output(command):
    options = ["--map", "run"] if command == "localize" else []
    words = line(command=command, source=["x"] * SOURCES.get(command, 1), options=options)
    name = command.split()
    assert words[: len(name)] == name
    _command(command).make_context("recon", words[len(name) :])
    named = [one for one in _command(command).params if one.opts[0].startswith("--")]
    kinds = {one.opts[0]: getattr(one, "type_descriptor", None) or one.type for one in named}
    paths = {option for option, kind in kinds.items() if "path" in str(kind).lower()}
    assert "--config" in paths or "--out" in paths or command.startswith("evaluate")
    assert paths - INPUTS <= _NOT_OPTIONS


def test_the_folder_of_a_scene_is_a_pair_with_calibration_and_truth(tmp_path):
    for name in ("im0.png", "im1.png", "calib.txt", "disp0GT.pfm"):
        (tmp_path / name).touch()
    words = line(tmp_path, command="pair", source=[str(tmp_path)])
    assert words[:7] == [
        "pair", f"{tmp_path}/im0.png", f"{tmp_path}/im1.png", "--calib", f"{tmp_path}/calib.txt",
        "--truth", f"{tmp_path}/disp0GT.pfm",
    ]  # fmt: skip
    words = line(tmp_path, command="pair", source=["nowhere"])  # its job says that it is not there
    assert words[:3] == ["pair", f"{tmp_path}/nowhere/im0.png", f"{tmp_path}/nowhere/im1.png"]


def test_what_was_begun_is_resumed_with_its_limits(tmp_path):
    (job,) = plan({**DRIVE, "threads": 3, "memory": "2G"})
    assert job.command_line(tmp_path, resume=True) == [
        "map", "--resume", str(tmp_path), "--threads", "3", "--memory-limit", "2G", "--json",
        "--verbose",
    ]  # fmt: skip
    job = piece_job(tmp_path / "pieces.json", 3, Piece(80, 140, 20), 2)
    words = ["piece", str(tmp_path / "pieces.json"), "3", "--threads", "2", "--json", "--verbose"]
    assert job.command_line(tmp_path / "3") == [*words, "--out", str(tmp_path / "3")]
    resumed = job.command_line(tmp_path / "3", resume=True)
    assert resumed == [*words, "--resume", str(tmp_path / "3")]


def test_a_sweep_spreads_every_job_over_every_combination_of_right_values():
    sweep = {"matching__window_px": [9, 11], "matching__matcher": ["sad", "sgm"]}
    jobs = plan(DRIVE, {**DRIVE, "name": "b"}, **sweep)
    assert (len(jobs), jobs[0].name) == (8, "a_window_px=9_matcher=sad")
    found = jobs[0].words
    assert found[-4:] == (
        "--set", "matching.window_px=9", "--set", 'matching.matcher="sad"',
    )  # fmt: skip
    assert jobs[7].name == "b_window_px=11_matcher=sgm"
    assert jobs[7].swept == {"matching.window_px": 11, "matching.matcher": "sgm"}
    with pytest.raises(SettingsError, match=r"job a: .*matching\.window_px"):
        plan(DRIVE, matching__window_px=[9, 11, "much"])


TWO = {"command": "evaluate disparity", "source": ["a", "b"]}
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"command": "batch"}, "job a: unknown command .*got batch"),
    ({"command": "map drive2"}, "unknown command"),
    ({"command": ""}, "unknown command"),
    ({"source": []}, "job a: job has no source"),
    ({"source": ["x", "--repair=/abs"]}, "source is an option"),
    ({"name": "../a"}, "not a name of a folder"),
    ({"set": ["matching.window_px=8"]}, "job a: .*matching.window_px"),
    ({"options": ["--no-such"]}, "job a: No such option.*no-such"),
    ({"options": ["another"]}, "unexpected extra argument"),
    ({"command": "evaluate trajectory"}, "Missing argument"),
    ({"memory": "much"}, "cannot read this size"),
    ({**TWO, "set": ["matching.window_px=9"]}, "job a: command has no settings"),
    *(
        ({"options": options.split()}, "job a: a job cannot have this option")
        for options in (
            "--", "--help", "-q", "-o/abs", "-vo/abs", "--out=/abs", "--resume x", "--into run",
            "--into run --remove 0", "--json",
        )
    ),
    *(
        ({"command": command, "options": [option]}, "a job cannot have this option")
        for command, option in (
            ("audit", "--repair=/abs.yaml"), ("evaluate occupancy", "--picture=/abs.png"),
            ("evaluate middlebury", "--latex"),
        )
    ),
    *(
        ({"options": options.split()}, "job a: a setting among the options")
        for options in ("--set a=b", "--set=a=b", "-sa=b", "-s a=b")
    ),
]  # fmt: skip
"""Jobs that are none, write elsewhere than into their folder, or have settings among options."""


@pytest.mark.parametrize(("changes", "words"), REFUSED)
def test_jobs_that_are_none_are_one_line(changes, words):
    with pytest.raises(SettingsError, match=words) as told:
        line(**changes)
    assert "\n" not in str(told.value)


def job(name: str, state: str = "succeeded", **more: Any) -> JobSummary:
    figures = more.pop("figures", {})
    facts = JobFacts(
        name=name,
        command="map",
        source="",
        state=state,
        tries=1,
        seconds=12.34,
        worker="",
        bytes=5_000_000,
        **more,
    )
    return JobSummary(facts=facts, figures=figures, warnings=())


def batch(jobs: list[JobSummary]) -> BatchSummary:
    failed = sum(one.facts.state == "failed" for one in jobs)
    ended = {"succeeded": len(jobs) - failed, "failed": failed, "not_run": 0}
    return BatchSummary(jobs=jobs, **ended, bytes=0, jobs_per_hour=None, out="outputs/week")


@pytest.mark.parametrize("name", ["drive[/b]", "[red]drive", "drive\x1b[2J\x9b2J", "\udcff\x07"])
def test_a_name_is_printed_as_it_is_without_commands_to_the_terminal(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    print_remarks([("warning", f"{name}: odd")])
    print_figures({"source": name, "control": {name: "used"}})
    print_rows([(name,), ("cloud", name, name)])
    out, err = capsys.readouterr()
    said = "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in name)
    assert out.count(said) == 5
    assert err == f"warning: {said}: odd\n"
    assert {letter for letter in out + err if not letter.isprintable()} == {"\n"}


def test_warnings_that_differ_in_numbers_alone_are_counted_unless_all_are_asked_for(capsys):
    remarks = [("warning", f"frame {n}: too dark") for n in range(3)] + [("note", "tilt it")]
    print_remarks(remarks)
    assert capsys.readouterr().err.splitlines() == [
        "warning: frame 0: too dark (and 2 more like it)",
        "note: tilt it",
    ]
    print_remarks(remarks, verbose=True)
    assert len(capsys.readouterr().err.splitlines()) == 4


def test_the_table_has_the_accuracy_of_each_command_and_not_all_of_very_many_jobs(
    capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "80")
    jobs = [
        job("drive_window=9", figures={"trajectory.t_rel_percent": 0.512345, "points": 7.0}),
        job("pair_window=9", figures={"disparity.bad.2.0": 6.5, "points": 7.0}, remark="odd"),
        job("nowhere", "failed", error="there is no such folder"),
    ]
    print_batch(batch(jobs), verbose=True)
    out, err = capsys.readouterr()
    for word in ("trajectory t", "disparity bad", "0.5123", "6.5", "drive_window=9"):
        assert word in out
    assert "points" not in out
    assert "remark: pair_window=9: odd" in out
    assert err == "error: nowhere: there is no such folder\n"
    assert max(map(len, out.splitlines())) <= 80
    print_batch(batch([job(f"j{n}") for n in range(1000)]), verbose=True)
    out = capsys.readouterr().out
    assert "j199 " in out
    assert "j200 " not in out
    assert "and 800 more, in table.csv" in out
