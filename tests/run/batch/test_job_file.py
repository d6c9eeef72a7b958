"""What a job file can say, and how everything else is refused."""

from pathlib import Path

import pytest

from recon.core.errors import ReconError, SettingsError
from recon.run.batch.job_file import check_names, jobs_of_sources, read_jobs, read_plan

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
SWEEP = '[sweep]\n"matching.window_px" = [9, 11]\n"matching.matcher" = ["sad", "sgm"]\n'


def write(folder: Path, text: str, suffix: str = "toml") -> Path:
    path = folder / f"jobs.{suffix}"
    path.write_text(text)
    return path


def test_a_job_has_all_that_it_says_behind_what_the_batch_says(tmp_path):
    listed = read_jobs(write(tmp_path, FULL))
    assert listed.folder == str(tmp_path)
    monday, pair = listed.job
    assert (monday.name, monday.command, monday.source) == ("monday", "map", ["drives/monday"])
    assert (monday.options, monday.set) == (["--no-mesh"], ["odometry.method=visual"])
    assert (monday.threads, monday.memory, monday.timeout_s, monday.retries) == (2, "4G", 60, 0)
    assert (pair.source, pair.options, pair.timeout_s) == (["left.png", "right.png"], [], None)
    limits = {"threads": 1, "memory": "2G", "timeout_s": 5.0, "retries": 4}
    listed = read_jobs(write(tmp_path, FULL)).with_limits(["x=1"], ["--poses=p"], **limits)
    monday, pair = listed.job
    assert monday.set == ["x=1", "odometry.method=visual"]
    assert monday.options == ["--poses=p", "--no-mesh"]
    assert (monday.threads, monday.memory, monday.timeout_s, monday.retries) == (2, "4G", 60, 0)
    assert (pair.threads, pair.memory, pair.timeout_s, pair.retries) == (1, "2G", 5.0, 4)


def test_yaml_says_the_same_and_its_recursion_is_one_line(tmp_path):
    text = "job:\n- {name: monday, command: map, source: drives/monday, set: [a=1]}\n"
    (entry,) = read_jobs(write(tmp_path, text, "yaml")).job
    assert (entry.name, entry.source, entry.set) == ("monday", ["drives/monday"], ["a=1"])
    with pytest.raises(ReconError, match=r"expand to too many|not a table"):
        read_jobs(write(tmp_path, "job: &a\n- *a\n", "yaml"))


def test_what_a_batch_was_begun_with_is_read_as_it_was_written(tmp_path):
    listed = read_jobs(write(tmp_path, SWEEP + FULL)).with_limits(["x=1"], [], threads=3)
    (tmp_path / "out").mkdir()
    listed.write(tmp_path / "out")
    assert read_plan(tmp_path / "out") == listed


@pytest.mark.parametrize(
    "content", ["", "3", "[3]", '{"x": 1}', "{", '{"job": [{"name": "a"}]}', '[{"name": "a"}]']
)
def test_a_damaged_plan_is_one_line(tmp_path, content):
    (tmp_path / "jobs.json").write_text(content)
    with pytest.raises(ReconError, match=r"jobs\.json"):
        read_plan(tmp_path)


def test_sources_are_named_by_as_many_of_their_last_parts_as_tell_them_apart():
    for sources, names in (
        (["a/2011_09 x", "b/.c/"], ["2011_09-x", "c"]),
        (
            ["robot1/monday", "Robot2/monday", "robot2/friday"],
            ["robot1_monday", "Robot2_monday", "robot2_friday"],
        ),
    ):
        assert [entry.name for entry in jobs_of_sources("map", sources).job] == names
    for same in (["a/x", "b/../a/x"], ["/", "/"]):
        listed = jobs_of_sources("map", same)
        with pytest.raises(SettingsError, match=r"two jobs have one name.*in a file"):
            check_names(one.name for one in listed.job)


def one_job(**changes: str) -> str:
    values = {"name": '"a"', "command": '"map"', "source": '"s"', **changes}
    return "[[job]]\n" + "".join(f"{key} = {value}\n" for key, value in values.items() if value)


NAMES = ["../a", "/a", "a/b", "..", ".hidden", "", "a\\\\b", "a b", "é", "-a", "a" * 200]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("[[job]]\n[[job", "not a TOML"),
        ("jobs = 3", "'job'.*required"),
        ("job = []", "'job'.*at least 1"),
        (one_job(sorce='"x"'), r"unknown setting 'job\.0\.sorce'; .*source"),
        (one_job(swept="{}"), r"unknown setting 'job\.0\.swept'"),
        (one_job(command=""), r"'job\.0\.command'.*required"),
        (one_job(source="3"), r"'job\.0\.source'.*got 3"),
        (one_job(set='"a=1"'), "set'.*got 'a=1'"),
        (one_job(threads="0"), "threads'.*got 0"),
        (one_job(threads="true"), "threads'.*got True"),
        (one_job(timeout_s='"1 h"'), "timeout_s'.*got '1 h'"),
        (one_job(timeout_s="nan"), "timeout_s'.*got nan"),
        (one_job(retries="-1"), "retries'.*got -1"),
        ("sweep = 3\n" + one_job(), "setting 'sweep"),
        ("[sweep]\na = []\n" + one_job(), "setting 'sweep"),
        ("[sweep]\na = [[1]]\n" + one_job(), "setting 'sweep"),
        ("[sweep]\na = [nan]\n" + one_job(), "setting 'sweep"),
        (f"[sweep]\na = {[*range(1001)]}\nb = {[*range(1001)]}\n" + one_job(), "too many jobs"),
        ("job = " + "[" * 5000, "deep|not a TOML"),
    ],
)  # fmt: skip
def test_everything_else_is_one_line(tmp_path, text, words):
    with pytest.raises(ReconError, match=words) as told:
        read_jobs(write(tmp_path, text))
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 1000


@pytest.mark.parametrize(
    ("names", "words"),
    [*(([name], "not a name of a folder") for name in NAMES),
     *(([name], "that of a file of the batch") for name in
       ("jobs.json", "Summary.JSON", "report.html", "table.csv", "logs", "run.json")),
     (["a", "A"], "job A: two jobs have one name")],
)  # fmt: skip
def test_a_name_is_that_of_a_folder_below_the_batch_alone(names, words):
    with pytest.raises(SettingsError, match=words):
        check_names(names)
