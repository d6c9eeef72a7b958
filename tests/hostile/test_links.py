"""Files that lead elsewhere, by links or by what records say, and files that commands may replace.

Files outside of a folder, of which ``outside`` has one, stay as they are in all of these tests.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

import recon
from recon.commands.datasets import run_fetch, run_verify
from recon.commands.demo import demo_source
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError
from recon.io.atomic import check_targets
from recon.io.files import resolved
from recon.sources.datasets import RECORD
from tests.hostile.conftest import DRIVE
from tests.hostile.refusals import assert_refused, refusal, run

pytestmark = pytest.mark.usefixtures("blank_figures")
EXPORT: Final = ("export", "run", "--to", "cloud", "--out", "evil")


@pytest.fixture
def outside(here):
    folder = here / "outside"
    folder.mkdir()
    (folder / "file").write_text("precious")
    return folder


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def state(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Kind, number and content of all that is in a folder, links not followed."""
    return {
        str(path): (*path.lstat()[:2], path.read_bytes() if path.is_file() else b"")
        for path in folder.rglob("*")
    }


def evil(record: object = None) -> Path:
    folder = Path("evil")
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps(record or {}))
    return folder


@pytest.mark.parametrize(("link", "target"), [
    ("sub", ""),  # before a stale file
    ("map", ""),
    ("map/deep/er", ""),
    (".partial", ""),
    (".partial/.lock", "lock"),
    ("config.yaml", "file"),
])  # fmt: skip
def test_no_link_below_a_result_folder_is_followed(link, target, finished, outside):
    path = evil({"files": ["sub/file"]}) / link
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(outside / target)
    before = sorted(Path("evil").iterdir())
    assert_refused(run(*EXPORT), f"evil/{link}", "link")
    assert content(outside) == {"file": "precious"}
    assert sorted(Path("evil").iterdir()) == before


def test_the_result_folder_itself_may_be_a_link(finished):
    (finished.parent / "real").mkdir()
    (finished.parent / "evil").symlink_to("real")
    assert run(*EXPORT).code == 0
    assert Path("real/map/cloud.ply").is_file()
    assert Path("evil").is_symlink()


READERS: Final = (
    "export run --out out",
    "mesh run --out out",
    "occupancy run --out out",
    "evaluate map run run/map/cloud.ply",
    "evaluate occupancy run",
    "merge other run --out out",
    "merge run other --out out",
    "map --into run --remove 0",
    "localize drive --map run --out out --quiet",
    "map drive --into run --quiet",
)


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize("link", ["map", "map/map.recon"])
def test_a_run_that_leads_elsewhere_is_not_read(command, link, finished, good_state):
    Path("drive").symlink_to(good_state / "drive")
    shutil.copytree(finished, "other")
    place = finished / link
    moved = place.rename(finished.parent / "moved")
    place.symlink_to(moved)
    assert_refused(run(*command.split()), f"run/{link}", "link")
    assert place.is_symlink()
    assert not Path("out").exists()


def test_an_unfinished_run_elsewhere_is_not_resumed(interrupted, outside):
    state = interrupted / ".partial" / ".state"
    shutil.move(state, outside / "state")
    state.symlink_to(outside / "state")
    before = (outside / "state" / "map.recon").read_bytes()
    assert_refused(run("map", "--resume", interrupted, "--quiet"), "link")
    assert (outside / "state" / "map.recon").read_bytes() == before


def test_a_batch_that_leads_elsewhere_is_not_resumed(here, outside):
    (here / "batch").mkdir()
    (here / "batch" / "job").symlink_to(outside)
    plan = {"folder": str(here), "job": [{"name": "job", "command": "demo"}]}
    (here / "batch" / "jobs.json").write_text(json.dumps(plan))
    assert_refused(run("batch", "--resume", "batch"), "batch/job", "link")
    assert content(outside) == {"file": "precious"}


def test_the_folder_in_which_a_merge_is_made_leads_nowhere(finished, outside):
    shutil.copytree(finished, "other")
    Path(".out.partial").symlink_to(outside)
    run("merge", "run", "other", "--out", "out", "--quiet")
    assert content(outside) == {"file": "precious"}


RECORDS: Final = {
    "a number": '{"files": [1]}',
    "null": '{"files": [null]}',
    "no list": '{"files": 5}',
    "NUL": '{"files": ["a\\u0000b"]}',
    "a surrogate": '{"files": ["\\ud800"]}',
    "an empty name": '{"files": [""]}',
    "a long name": json.dumps({"files": ["x" * 5000]}),
    "a table": '{"files": {"a": 1}}',
    "deep files": '{"files":' + "[" * 100_000,
}


@pytest.mark.parametrize("record", RECORDS)
def test_a_folder_whose_record_is_none_is_refused(record, finished):
    (evil() / "run.json").write_text(RECORDS[record])
    assert_refused(run(*EXPORT), "evil/run.json")
    assert [path.name for path in Path("evil").iterdir()] == ["run.json"]


def test_folders_and_outside_files_in_a_list_of_files_stay(finished, outside):
    listed = ["sub", ".", "..", "../outside/file", str(outside / "file"), "run.json/x"]
    (evil({"files": listed}) / "sub").mkdir()
    assert run(*EXPORT).code == 0
    assert Path("evil/sub").is_dir()
    assert content(outside) == {"file": "precious"}


def small_drive() -> recon.StereoSource:
    return demo_source(recon.load_config(None, [f"street.{k}={v}" for k, v in DRIVE.items()]))


TAKERS: Final[dict[str, Callable[[Path], object]]] = {
    "source": recon.open_source,
    "map": recon.Map.open,
    "run_map": lambda loop: recon.run_map(small_drive(), None, MapOptions(out=loop, audit=False)),
    "run_localize": lambda loop: recon.run_localize(
        small_drive(), loop, options=MapOptions(out=loop)
    ),
    "run_merge": lambda loop: recon.run_merge([loop, loop]),
    "run_export": lambda loop: recon.run_export(loop, products=["cloud"], out=loop),
    "run_middlebury": recon.run_middlebury,
    "scene": recon.read_middlebury_scene,
    "calibration": recon.read_calibration,
    "data sets": lambda loop: run_fetch([PART], loop),
    "resolved": resolved,
    "written": lambda loop: check_targets([loop]),
}


@pytest.mark.parametrize("loop", ["loop", "loop/deep/er"])
@pytest.mark.parametrize("taker", TAKERS)
def test_a_loop_of_links_is_refused_in_python_too(taker, loop, here):
    Path("loop").symlink_to("loop")
    assert refusal(lambda: TAKERS[taker](Path(loop))) is not None
    assert [path.name for path in here.iterdir()] == ["loop"]


PART: Final = "middlebury-2014/Pipes"
DOWN: Final = f".partial/{PART}"


@pytest.mark.parametrize(
    "link",
    ["middlebury-2014", PART, ".partial", DOWN, f"{DOWN}/Pipes-perfect.zip", f"{DOWN}/files"],
)
def test_no_link_among_data_sets_is_followed(link, here, outside):
    path = here / "data" / link
    path.parent.mkdir(parents=True)
    path.symlink_to(outside)
    with pytest.raises(FormatError, match="link") as refused:
        run_fetch([PART], here / "data", address="http://127.0.0.1:1")
    assert refused.value.where == path
    assert content(outside) == {"file": "precious"}


@pytest.mark.parametrize("link", ["middlebury-2014", PART, f"{PART}/deep"])
def test_data_that_lead_elsewhere_are_not_verified(link, here):
    place = here / "real" / PART
    (place / "deep").mkdir(parents=True)
    (place / RECORD).write_text('{"files": {}}')
    (here / "data").symlink_to(here / "real")  # the folder itself may be a link
    assert run_verify([PART], here / "data")["datasets"]
    moved = (here / "real" / link).rename(here / "moved")
    (here / "real" / link).symlink_to(moved)
    with pytest.raises(FormatError, match="link") as refused:
        run_verify([PART], here / "real")
    assert refused.value.where == here / "real" / link


TARGETS: Final[dict[str, Callable[[Path], None]]] = {
    "a device": lambda path: path.symlink_to(os.devnull),
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "the calibration by a hard link": lambda path: path.hardlink_to("drive/calib.txt"),
    "the calibration by a link": lambda path: path.symlink_to("drive/calib.txt"),
    "an image by a link to a link": lambda path: path.symlink_to("between"),
    "the configuration": lambda path: path.symlink_to("config.yaml"),
}


@pytest.mark.parametrize("target", TARGETS)
def test_a_mended_calibration_replaces_no_input_and_no_device(drive, target):
    Path("config.yaml").write_text("matching: {matcher: sad}\n")
    Path("between").symlink_to("drive/image_0/000001.png")
    TARGETS[target](Path("target.yaml"))
    before = state(drive.parent)
    command = ("audit", "drive", "--config", "config.yaml", "--repair", "target.yaml", "--quiet")
    assert_refused(run(*command), "target.yaml: ")
    assert state(drive.parent) == before


def test_a_calibration_replaces_no_picture_of_the_board(pair):
    Path("rig_left.yaml").hardlink_to("left.png")
    before = state(pair[0].parent)
    board = ("--board", "chess:9x6:25mm", "--report", "report")
    ours = ("--format", "recon")
    for words in (("left.png", *ours), ("right.png", *ours), ("rig.yaml", "--format", "ros")):
        command = ("calibrate", "left.png", "right.png", *board, "-o", *words)
        assert_refused(run(*command), "would replace an input")
    assert state(pair[0].parent) == before


def test_a_board_is_not_printed_into_a_device(here):
    Path("board.pdf").symlink_to(os.devnull)
    assert_refused(run("board", "chess:9x6:25mm"), "board.pdf: ", "a device")
    assert Path("board.pdf").is_symlink()


@pytest.mark.parametrize("name", ["map/grid.pgm", "run.json"])
def test_a_drawing_replaces_no_file_of_the_run(finished, name):
    before = state(finished)
    command = ("evaluate", "occupancy", "run", "--picture", f"run/{name}")
    assert_refused(run(*command), f"run/{name}", "would replace an input")
    assert state(finished) == before


MADE_OF: Final = {
    "a map compared with itself": "evaluate map run run/map/cloud.ply",
    "its cloud": "evaluate map run/map/cloud.ply run/map/cloud.ply",
    "its path": "evaluate trajectory run/trajectory_tum.txt run/trajectory_tum.txt",
    "a drive at its poses": "map drive --poses run/trajectory_tum.txt",
}


@pytest.mark.parametrize("command", MADE_OF)
@pytest.mark.parametrize("out", ["run", "linked"])
def test_results_replace_no_input(command, out, finished, good_state):
    Path("drive").symlink_to(good_state / "drive")
    shutil.copytree(finished, "linked")
    for name in ("map/cloud.ply", "trajectory_tum.txt"):
        Path("linked", name).unlink()
        Path("linked", name).hardlink_to(finished / name)
    Path(out, "map/map.recon").unlink()  # in place of a map there is nothing at all
    before = state(Path(out))
    assert_refused(run(*MADE_OF[command].split(), "--out", out), "would replace an input")
    assert state(Path(out)) == before


def test_results_do_not_replace_what_is_no_regular_file(finished):
    shutil.copytree(finished, "other")
    Path("other/map/map.recon").unlink()
    Path("other/map/cloud.ply").unlink()
    os.mkfifo("other/map/cloud.ply")
    before = state(Path("other"))
    assert_refused(run("export", "run", "--to", "cloud", "--out", "other"), "a named pipe")
    assert state(Path("other")) == before
