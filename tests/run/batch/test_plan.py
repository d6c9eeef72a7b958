"""Command lines of jobs are those of the program, and stay in their folder."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from recon.cli import app
from recon.cli.program import known_program
from recon.commands.piece import piece_job
from recon.core.errors import ReconError, SettingsError
from recon.map.drive.pieces import Piece
from recon.run.batch.job_file import Entry, check_names
from recon.run.batch.plan import Limits, plan_jobs, read_plan, write_plan
from recon.run.directory import STARTED, state_folder
from tests.docs.blocks import ROOT

DRIVE = Entry("a", "map", ("drive",))
PROGRAM = known_program()


def planned(entry: Entry, limits: Limits | None = None, folder: Path = ROOT) -> list[str]:
    (job,) = plan_jobs([entry], PROGRAM, limits or Limits(), folder)
    return job.command_line(Path("out"))


def test_a_command_line_has_what_the_job_says() -> None:
    entry = replace(DRIVE, options=("--no-mesh",), set=("a.b=1",), threads=2, memory="4G")
    assert planned(entry) == [
        "map", "drive", "--set", "a.b=1", "--threads", "2", "--memory-limit", "4G", "--no-mesh",
        "--out", "out", "--json", "--verbose",
    ]  # fmt: skip


def test_limits_of_the_batch_hold_for_jobs_without_their_own() -> None:
    jobs = plan_jobs(
        [DRIVE, replace(DRIVE, name="b", threads=2, timeout_s=5.0, retries=0)],
        PROGRAM,
        Limits(threads=1, memory="2G", timeout_s=60.0, retries=4),
        ROOT,
    )
    assert [(job.timeout_s, job.retries) for job in jobs] == [(60.0, 4), (5.0, 0)]
    assert [dict(job.needs) for job in jobs] == [
        {"threads": 1.0, "memory": 2e9}, {"threads": 2.0, "memory": 2e9},
    ]  # fmt: skip


def test_an_option_that_a_command_does_not_have_is_left_out_of_the_limits() -> None:
    entry = Entry("a", "evaluate trajectory", ("a.txt", "b.txt"))
    line = planned(entry, Limits(threads=1, memory="2G"))
    assert line[:4] == ["evaluate", "trajectory", "a.txt", "b.txt"]
    assert not {"--threads", "--memory-limit"} & set(line)


def test_a_demo_needs_no_source() -> None:
    assert planned(Entry("a", "demo", options=("--frames", "6")))[:3] == ["demo", "--frames", "6"]


def test_the_folder_of_a_scene_is_a_pair_with_calibration_and_truth(tmp_path: Path) -> None:
    for name in ("im0.png", "im1.png", "calib.txt", "disp0GT.pfm"):
        (tmp_path / name).touch()
    line = planned(Entry("a", "pair", (str(tmp_path),)), folder=tmp_path)
    assert line[:7] == [
        "pair", f"{tmp_path}/im0.png", f"{tmp_path}/im1.png", "--calib", f"{tmp_path}/calib.txt",
        "--truth", f"{tmp_path}/disp0GT.pfm",
    ]  # fmt: skip


def test_a_scene_that_is_not_there_is_left_to_its_job(tmp_path: Path) -> None:
    line = planned(Entry("a", "pair", ("nowhere",)), folder=tmp_path)
    assert line[:3] == ["pair", f"{tmp_path}/nowhere/im0.png", f"{tmp_path}/nowhere/im1.png"]


def test_a_run_that_was_begun_is_resumed_with_its_limits(tmp_path: Path) -> None:
    (job,) = plan_jobs([DRIVE], PROGRAM, Limits(threads=3, memory="2G"), ROOT)
    state_folder(tmp_path).mkdir(parents=True)
    (state_folder(tmp_path) / STARTED).touch()
    assert job.command_line(tmp_path) == [
        "map", "--resume", str(tmp_path), "--threads", "3", "--memory-limit", "2G", "--json",
        "--verbose",
    ]  # fmt: skip
    assert job.command_line(tmp_path, anew=True)[:2] == ["map", "drive"]


def test_a_piece_that_was_begun_is_told_again_what_it_is_of(tmp_path: Path) -> None:
    job = piece_job(tmp_path / "pieces.json", 3, Piece(80, 140, 20), Limits(threads=2))
    words = ["piece", str(tmp_path / "pieces.json"), "3", "--threads", "2"]
    assert job.command_line(tmp_path / "3")[:7] == [*words, "--out", str(tmp_path / "3")]
    state_folder(tmp_path / "3").mkdir(parents=True)
    (state_folder(tmp_path / "3") / STARTED).touch()
    assert job.command_line(tmp_path / "3")[:7] == [*words, "--resume", str(tmp_path / "3")]


def test_a_plan_is_read_as_it_was_written(tmp_path: Path) -> None:
    swept = replace(DRIVE, swept={"matching.sad.window_px": 9}, timeout_s=5.0, memory="1G")
    jobs = plan_jobs([swept, replace(DRIVE, name="b")], PROGRAM, Limits(), ROOT)
    write_plan(jobs, tmp_path)
    assert read_plan(tmp_path) == jobs


@pytest.mark.parametrize("content", ["", "3", "[3]", '[{"name": "a"}]', '[{"x": 1}]', "{"])
def test_a_damaged_plan_is_one_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "jobs.json").write_text(content)
    with pytest.raises(ReconError, match=r"jobs\.json"):
        read_plan(tmp_path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "../outside"}, "not a name of a folder"),
        ({"name": "/outside"}, "not a name of a folder"),
        ({"words": ["map", "drive", "--out", "/outside"]}, "cannot have this option"),
    ],
)
def test_a_plan_from_elsewhere_that_writes_outside_is_refused(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    (job,) = plan_jobs([DRIVE], PROGRAM, Limits(), ROOT)
    (tmp_path / "jobs.json").write_text(json.dumps([{**job.plain(), **changes}]))
    with pytest.raises(SettingsError, match=words):
        read_plan(tmp_path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"command": "mapp"}, "job a: unknown command .*got mapp"),
        ({"command": "batch"}, "unknown command"),
        ({"source": ()}, "job a: job has no source"),
        ({"command": "rm -rf /"}, "unknown command"),
        ({"command": "map drive2"}, "unknown command"),
        ({"command": ""}, "unknown command"),
        ({"options": ("--out", "/elsewhere")}, "cannot have this option .*--out"),
        ({"options": ("--out=/elsewhere",)}, "cannot have this option"),
        ({"options": ("-o/elsewhere",)}, "cannot have this option"),
        ({"options": ("--resume", "x")}, "cannot have this option"),
        ({"options": ("--help",)}, "cannot have this option"),
        ({"options": ("--no-such",)}, "job a: No such option.*no-such"),
        ({"options": ("another",)}, "unexpected extra argument"),
        ({"source": ("a", "b")}, "unexpected extra argument"),
        ({"command": "evaluate trajectory"}, "Missing argument"),
        ({"memory": "much"}, "cannot read this size"),
    ],
)
def test_jobs_that_are_none_are_one_line(changes: dict[str, object], words: str) -> None:
    with pytest.raises(SettingsError, match=words) as told:
        plan_jobs([replace(DRIVE, **changes)], PROGRAM, Limits(), ROOT)
    assert "\n" not in str(told.value)


def test_every_command_of_a_batch_is_one_of_the_program_or_to_come() -> None:
    assert {"map", "pair", "evaluate trajectory", "evaluate middlebury"} <= set(PROGRAM.commands)
    assert "batch" not in PROGRAM.commands
    assert os.sep not in "".join(PROGRAM.commands)


@pytest.mark.parametrize(
    "options",
    [("--",), ("--into", "run"), ("--mend", "/abs.yaml"), ("--picture=/abs.png",), ("-q",)],
)
def test_a_job_writes_into_its_own_folder_alone(options: tuple[str, ...]) -> None:
    with pytest.raises(SettingsError, match="a job cannot have this option"):
        planned(replace(DRIVE, options=options))


@pytest.mark.parametrize("options", [("--set", "a=b"), ("--set=a=b",), ("-sa=b",), ("-s", "a=b")])
def test_settings_among_the_options_are_refused(options: tuple[str, ...]) -> None:
    with pytest.raises(SettingsError, match="a setting among the options"):
        planned(replace(DRIVE, options=options))


@pytest.mark.parametrize("name", ["jobs.json", "Summary.JSON", "report.html", "table.csv"])
def test_a_job_is_not_named_like_a_file_of_the_batch(name: str) -> None:
    with pytest.raises(SettingsError, match="that of a file of the batch"):
        check_names([replace(DRIVE, name=name)], "jobs.toml")


def test_no_help_loses_words_in_brackets_to_the_markup() -> None:
    texts = [each.callback.__doc__ or "" for each in app.registered_commands if each.callback]
    assert "recon\\[cluster]" in "".join(texts)
    assert [text for text in texts if re.search(r"(?<!\\)\[[a-z]+\]", text)] == []
