"""Result folders from elsewhere that lead to other files: by links, and by what their records say.

Files outside of the folder, of which ``outside`` has one, stay as they are in all of these tests.
"""

from __future__ import annotations

import json
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
from tests.hostile.refusals import assert_refused, refusal, run
from tests.hostile.runs import DRIVE

pytestmark = pytest.mark.usefixtures("blank_figures")
EXPORT: Final = ("export", "run", "--to", "cloud", "--out", "evil")


@pytest.fixture
def outside(here: Path) -> Path:
    """A folder of somebody's, with one file."""
    folder = here / "outside"
    folder.mkdir()
    (folder / "file").write_text("precious")
    return folder


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def evil(record: object = None) -> Path:
    """Make a result folder with a record."""
    folder = Path("evil")
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps(record or {}))
    return folder


def a_stale_file_behind_a_link(outside: Path) -> str:
    (evil({"files": ["sub/file"]}) / "sub").symlink_to(outside)
    return "evil/sub"


def a_link_where_products_go(outside: Path) -> str:
    (evil() / "map").symlink_to(outside)
    return "evil/map"


def a_link_deep_in_the_folder(outside: Path) -> str:
    (evil() / "map" / "deep").mkdir(parents=True)
    (Path("evil") / "map" / "deep" / "er").symlink_to(outside)
    return "evil/map/deep/er"


def a_link_where_partial_files_go(outside: Path) -> str:
    (evil() / ".partial").symlink_to(outside)
    return "evil/.partial"


def a_link_for_the_lock(outside: Path) -> str:
    (evil() / ".partial").mkdir()
    (Path("evil") / ".partial" / ".lock").symlink_to(outside / "lock")
    return "evil/.partial/.lock"


def a_link_for_a_file(outside: Path) -> str:
    (evil() / "config.yaml").symlink_to(outside / "file")
    return "evil/config.yaml"


PLACES: Final[dict[str, Callable[[Path], str]]] = {
    make.__name__: make
    for make in (
        a_stale_file_behind_a_link,
        a_link_where_products_go,
        a_link_deep_in_the_folder,
        a_link_where_partial_files_go,
        a_link_for_the_lock,
        a_link_for_a_file,
    )
}


@pytest.mark.parametrize("place", PLACES)
def test_no_link_below_a_result_folder_is_followed(
    place: str, finished: Path, outside: Path
) -> None:
    named = PLACES[place](outside)
    before = sorted(Path("evil").iterdir())
    assert_refused(run(*EXPORT), named, "link")
    assert content(outside) == {"file": "precious"}
    assert sorted(Path("evil").iterdir()) == before


def test_the_result_folder_itself_may_be_a_link(finished: Path) -> None:
    (finished.parent / "real").mkdir()
    (finished.parent / "evil").symlink_to("real")
    assert run(*EXPORT).code == 0
    assert Path("real/map/cloud.ply").is_file()
    assert Path("evil").is_symlink()


READERS: Final = {
    "export": ("export", "run", "--out", "out"),
    "mesh": ("mesh", "run", "--out", "out"),
    "occupancy": ("occupancy", "run", "--out", "out"),
    "evaluate map": ("evaluate", "map", "run", "run/map/cloud.ply"),
    "evaluate occupancy": ("evaluate", "occupancy", "run"),
    "merge": ("merge", "other", "run", "--out", "out"),
    "merge first": ("merge", "run", "other", "--out", "out"),
    "remove": ("map", "--into", "run", "--remove", "0"),
}


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize("link", ["map", "map/map.recon"])
def test_a_run_that_leads_elsewhere_is_not_read(command: str, link: str, finished: Path) -> None:
    shutil.copytree(finished, "other")
    place = finished / link
    moved = place.rename(finished.parent / "moved")
    place.symlink_to(moved)
    assert_refused(run(*READERS[command]), f"run/{link}", "link")
    assert place.is_symlink()
    assert not Path("out").exists()


def test_a_map_that_leads_elsewhere_finds_no_drive(finished: Path, good_state: Path) -> None:
    (finished / "map").rename("moved")
    (finished / "map").symlink_to(finished.parent / "moved")
    drive = good_state / "drive"
    assert_refused(run("localize", drive, "--map", "run", "--out", "out", "--quiet"), "run/map")
    assert_refused(run("map", drive, "--into", "run", "--quiet"), "run/map")
    assert not Path("out").exists()


def test_an_unfinished_run_that_leads_elsewhere_is_not_resumed(
    interrupted: Path, outside: Path
) -> None:
    state = interrupted / ".partial" / ".state"
    shutil.move(state, outside / "state")
    state.symlink_to(outside / "state")
    before = (outside / "state" / "map.recon").read_bytes()
    assert_refused(run("map", "--resume", interrupted, "--quiet"), "link")
    assert (outside / "state" / "map.recon").read_bytes() == before


def test_a_batch_that_leads_elsewhere_is_not_resumed(here: Path) -> None:
    (here / "outside").mkdir()
    (here / "batch").mkdir()
    (here / "batch" / "job").symlink_to(here / "outside")
    plan = {"folder": str(here), "job": [{"name": "job", "command": "demo"}]}
    (here / "batch" / "jobs.json").write_text(json.dumps(plan))
    assert_refused(run("batch", "--resume", "batch"), "batch/job", "link")
    assert list((here / "outside").iterdir()) == []


def test_the_folder_in_which_a_merge_is_made_leads_nowhere(finished: Path, outside: Path) -> None:
    shutil.copytree(finished, "other")
    Path(".out.partial").symlink_to(outside)
    run("merge", "run", "other", "--out", "out", "--quiet")
    assert content(outside) == {"file": "precious"}


RECORDS: Final = {
    "a number": [1],
    "null": [None],
    "no list": 5,
    "NUL": ["a\0b"],
    "a surrogate": ["\ud800"],
    "an empty name": [""],
    "a long name": ["x" * 5000],
    "a table": {"a": 1},
}


@pytest.mark.parametrize("files", RECORDS)
def test_a_record_whose_list_of_files_is_none_is_refused(files: str, finished: Path) -> None:
    evil({"files": RECORDS[files]})
    assert_refused(run(*EXPORT), "evil/run.json")
    assert [path.name for path in Path("evil").iterdir()] == ["run.json"]


@pytest.mark.parametrize("text", ["[" * 100_000, "[]", "1", "", '{"files":' + "[" * 100_000, "\0"])
def test_a_folder_whose_record_is_none_is_refused(text: str, finished: Path) -> None:
    (evil() / "run.json").write_text(text)
    assert_refused(run(*EXPORT), "evil/run.json")


def test_folders_and_outside_files_in_a_list_of_files_stay(finished: Path, outside: Path) -> None:
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
def test_a_loop_of_links_is_refused_in_python_too(taker: str, loop: str, here: Path) -> None:
    Path("loop").symlink_to("loop")
    assert refusal(lambda: TAKERS[taker](Path(loop))) is not None
    assert [path.name for path in here.iterdir()] == ["loop"]


PART: Final = "middlebury-2014/Pipes"
LINKS_OF_DATA: Final = {
    "a family": "middlebury-2014",
    "a data set": PART,
    "downloads": ".partial",
    "a download": f".partial/{PART}",
    "an archive": f".partial/{PART}/Pipes-perfect.zip",
    "what was unpacked": f".partial/{PART}/files",
}


@pytest.mark.parametrize("link", LINKS_OF_DATA)
def test_no_link_below_a_folder_of_data_sets_is_followed(link: str, here: Path) -> None:
    outside = here / "outside"
    outside.mkdir()
    (outside / "file").write_text("precious")
    path = here / "data" / LINKS_OF_DATA[link]
    path.parent.mkdir(parents=True)
    path.symlink_to(outside)
    with pytest.raises(FormatError, match="link") as refused:
        run_fetch([PART], here / "data", address="http://127.0.0.1:1")
    assert refused.value.where == path
    assert content(outside) == {"file": "precious"}


@pytest.mark.parametrize("link", ["middlebury-2014", PART, f"{PART}/deep"])
def test_data_that_lead_elsewhere_are_not_verified(link: str, here: Path) -> None:
    place = here / "data" / PART
    (place / "deep").mkdir(parents=True)
    (place / RECORD).write_text('{"files": {}}')
    assert run_verify([PART], here / "data")["datasets"]
    moved = (here / "data" / link).rename(here / "moved")
    (here / "data" / link).symlink_to(moved)
    with pytest.raises(FormatError, match="link") as refused:
        run_verify([PART], here / "data")
    assert refused.value.where == here / "data" / link


def test_the_folder_of_data_sets_itself_may_be_a_link(here: Path) -> None:
    place = here / "real" / PART
    place.mkdir(parents=True)
    (place / RECORD).write_text('{"files": {}}')
    (here / "data").symlink_to(here / "real")
    assert run_verify([PART], here / "data")["datasets"]
