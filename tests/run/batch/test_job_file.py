"""What a job file can say, and how everything else is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from recon.core.errors import ReconError, SettingsError
from recon.run.batch.job_file import jobs_of_sources, read_jobs

FULL = """
[[job]]
name = "monday"
command = "map"
source = "drives/monday"
options = ["--no-mesh"]
set = ["odometry.method=visual"]
threads = 2
memory = "4G"
timeout_s = 60
retries = 0

[[job]]
name = "one.pair"
command = "pair"
source = ["left.png", "right.png"]
"""
SWEEP = '[sweep]\n"matching.sad.window_px" = [9, 11]\n"matching.matcher" = ["sad", "sgm"]\n'


def write(folder: Path, text: str, suffix: str = "toml") -> Path:
    path = folder / f"jobs.{suffix}"
    path.write_text(text)
    return path


def test_a_job_has_all_that_it_says(tmp_path: Path) -> None:
    monday, pair = read_jobs(write(tmp_path, FULL))
    assert (monday.name, monday.command, monday.source) == ("monday", "map", ("drives/monday",))
    assert (monday.options, monday.set) == (("--no-mesh",), ("odometry.method=visual",))
    assert (monday.threads, monday.memory, monday.timeout_s, monday.retries) == (2, "4G", 60, 0)
    assert (pair.source, pair.options, pair.timeout_s) == (("left.png", "right.png"), (), None)


def test_yaml_says_the_same(tmp_path: Path) -> None:
    text = "job:\n- {name: monday, command: map, source: drives/monday, set: [a=1]}\n"
    (entry,) = read_jobs(write(tmp_path, text, "yaml"))
    assert (entry.name, entry.source, entry.set) == ("monday", ("drives/monday",), ("a=1",))


def test_a_sweep_spreads_every_job_over_every_combination(tmp_path: Path) -> None:
    entries = read_jobs(write(tmp_path, SWEEP + FULL), settings=["x=1"], options=["--poses=p"])
    assert len(entries) == 8
    assert entries[0].name == "monday_window_px=9_matcher=sad"
    assert entries[0].set == (
        "x=1", "odometry.method=visual", "matching.sad.window_px=9", 'matching.matcher="sad"',
    )  # fmt: skip
    assert entries[0].options == ("--poses=p", "--no-mesh")
    assert entries[3].swept == {"matching.sad.window_px": 11, "matching.matcher": "sgm"}


def test_sources_are_named_by_their_last_part() -> None:
    entries = jobs_of_sources("map", ["a/2011_09 x", "b/.c/"], ["--no-mesh"], ["k=1"])
    assert [entry.name for entry in entries] == ["2011_09-x", "c"]


def test_sources_with_one_last_part_are_named_by_more_of_their_paths() -> None:
    entries = jobs_of_sources("map", ["robot1/monday", "Robot2/monday", "robot2/friday"], [], [])
    assert [entry.name for entry in entries] == ["robot1_monday", "Robot2_monday", "robot2_friday"]
    with pytest.raises(SettingsError, match=r"two jobs have one name.*got x.*in a file"):
        jobs_of_sources("map", ["a/x", "b/../a/x"], [], [])
    with pytest.raises(SettingsError, match="two jobs have one name"):
        jobs_of_sources("map", ["/", "/"], [], [])


def one_job(**changes: str) -> str:
    values = {"name": '"a"', "command": '"map"', "source": '"s"', **changes}
    return "[[job]]\n" + "".join(f"{key} = {value}\n" for key, value in values.items() if value)


NAMES = ["../a", "/a", "a/b", "..", ".hidden", "", "a\\\\b", "a b", "é", "-a", "a" * 200]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("[[job]]\n[[job", "not a TOML"),
        ("jobs = 3", "unknown key .*got jobs.*did you mean job"),
        ("job = 3", "there is no job"),
        ("job = []", "there is no job"),
        ("job = [3]", "job 1: job is not a table"),
        (one_job(sorce='"x"'), r"job 1: unknown key \(got sorce.*did you mean source"),
        (one_job(swept="{}"), "unknown key .*got swept"),
        (one_job(command=""), "job 1: job has no command"),
        (one_job(name=""), "job 1: job has no name"),
        (one_job(source="[]"), "source is not a list of texts"),
        (one_job(source="3"), "source is not a list of texts"),
        (one_job(name="3"), "name is not a text"),
        (one_job(set='"a=1"'), "set is not a list of texts"),
        (one_job(options="[1]"), "options is not a list of texts"),
        (one_job(threads="0"), "threads is not a number"),
        (one_job(threads="true"), "threads is not a number"),
        (one_job(timeout_s='"1 h"'), "timeout_s is not a number"),
        (one_job(timeout_s="nan"), "timeout_s is not a number"),
        (one_job(retries="-1"), "retries is not a number"),
        (one_job() + one_job(), "two jobs have one name"),
        (one_job() + one_job(name='"A"'), "two jobs have one name"),
        ("sweep = 3\n" + one_job(), "sweep is not a table of lists"),
        ("[sweep]\na = 3\n" + one_job(), "sweep is not a table of lists"),
        ("[sweep]\na = []\n" + one_job(), "sweep is not a table of lists"),
        ("[sweep]\na = [[1]]\n" + one_job(), "sweep is not a table of lists"),
        (f"[sweep]\na = {[*range(1001)]}\nb = {[*range(1001)]}\n" + one_job(), "too many jobs"),
        ("job = " + "[" * 5000, "deep|not a TOML"),
        *((one_job(name=f'"{name}"'), "not a name of a folder") for name in NAMES),
    ],
)  # fmt: skip
def test_everything_else_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ReconError, match=words) as told:
        read_jobs(write(tmp_path, text))
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 1000


def test_recursion_in_yaml_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ReconError, match=r"expand to too many|not a table"):
        read_jobs(write(tmp_path, "job: &a\n- *a\n", "yaml"))
